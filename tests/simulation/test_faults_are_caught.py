"""The simulation finds what it is there to find: each of a list of small deliberate mistakes."""

from __future__ import annotations

import functools

import pytest

import tests.simulation.hostile_faults  # it adds its mistakes
import tests.simulation.schedule_faults  # it adds its mistakes
import tests.simulation.store_faults  # noqa: F401  # it adds its mistakes
from tests.simulation.faults import MISTAKES, Mistake
from tests.simulation.generator import scenario_of
from tests.simulation.world import simulate

SEARCHED = 150
"""Seeds that are tried if none of those that are known finds the mistake any more."""


@functools.cache
def is_right(seed: int) -> bool:
    """Return whether a scenario goes well without a mistake; each seed is run once for all."""
    return not simulate(scenario_of(seed)).violations


def finds(seed: int, mistake: Mistake) -> bool:
    """Return whether a scenario goes wrong with the mistake, and not without it."""
    with mistake.made():
        wrong = simulate(scenario_of(seed))
    return bool(wrong.violations) and is_right(seed)


@pytest.mark.parametrize("mistake", MISTAKES.values(), ids=MISTAKES)
def test_a_small_mistake_in_the_product_is_found(mistake: Mistake) -> None:
    if any(finds(seed, mistake) for seed in mistake.seeds):
        return
    found = next((seed for seed in range(SEARCHED) if finds(seed, mistake)), None)
    assert found is not None, f"no scenario finds that {mistake.meaning}"


def test_a_mistake_is_gone_when_its_block_has_been_left() -> None:
    for mistake in MISTAKES.values():
        real = mistake.cls.__dict__[mistake.method]
        with mistake.made():
            assert mistake.cls.__dict__[mistake.method] is not real
        assert mistake.cls.__dict__[mistake.method] is real


def test_there_are_mistakes_of_all_kinds() -> None:
    assert len(MISTAKES) >= 20
    assert all(mistake.meaning for mistake in MISTAKES.values())

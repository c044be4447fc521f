"""Each attack on a participant of RTPS in its short form, beside an honest pair."""

from __future__ import annotations

import pytest

from tests.hostile.meter import Reading
from tests.hostile.rtps.crowd import CrowdFigures, broken_bounds, figures_of
from tests.hostile.rtps.datagram_attacks import DATAGRAM_ATTACKS

READING = Reading(0.01, 0, 100, 1.0, 40 * 2**20, 40 * 2**20, 0.0, "")
FIGURES = CrowdFigures(READING, 1.0, [0.001, 0.002], [0.001], 1000, 2000, 0.0002, 0.1, 0)


@pytest.mark.asyncio
@pytest.mark.parametrize("name", sorted(DATAGRAM_ATTACKS))
async def test_an_attack_by_datagrams_costs_the_others_little(name: str) -> None:
    found = await figures_of(name)

    assert broken_bounds(DATAGRAM_ATTACKS[name], found) == []


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"reading": READING._replace(longest=0.2)}, "a turn took 200 ms"),
        ({"work": [0.4]}, "400 ms of work"),
        ({"above": 5000.0}, "5000 MiB above the idle victim"),
        ({"stopped": 9.0}, "SIGTERM took 9.0 s"),
        ({"code": -9}, "exit code -9"),
        ({"sent": 10**9}, "it sent 1,000,000,000 bytes for 1,000"),
    ],
)
def test_each_broken_bound_of_datagrams_is_told(changed: dict[str, object], said: str) -> None:
    attack = next(iter(DATAGRAM_ATTACKS.values()))

    assert broken_bounds(attack, FIGURES, is_trial=True) == []
    told = broken_bounds(attack, FIGURES._replace(**changed), is_trial=True)  # type: ignore[arg-type]  # of each field
    assert said in " ".join(told)

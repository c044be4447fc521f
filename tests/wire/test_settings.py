from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, strategies

from fibaction.wire.frames import LEAST_FRAME
from fibaction.wire.settings import ClientSettings, Limits

NAMES = Limits.__struct_fields__
TESTS = Path(__file__).parents[1]
REACHED_IN = {
    "connections": "wire/test_admission.py",
    "per_address": "wire/test_admission.py",
    "goals": "wire/test_limits.py",
    "follows": "wire/test_admission.py",
    "lost": "wire/test_resume.py",
    "requests": "wire/test_limits.py",
    "frame": "wire/test_limits.py",
    "memory": "wire/test_limits.py",
    "total_memory": "wire/test_limits.py",
    "queue": "wire/test_limits.py",
    "handshake": "transports/test_bad_input.py",
    "heartbeat": "wire/test_admission.py",
    "write": "hostile/test_doors.py",
}
"""The tests in which a client reaches each limit."""


def test_each_limit_is_reached_in_a_test() -> None:
    assert {*NAMES} == {*REACHED_IN}
    for name, file in REACHED_IN.items():
        assert re.search(rf"\b{name}(=|\": )", (TESTS / file).read_text(encoding="utf-8"))


@given(strategies.sampled_from(NAMES), strategies.integers(LEAST_FRAME, 2**32 - 1))
def test_any_number_above_zero_is_a_limit(name: str, value: int) -> None:
    limits = Limits(**{name: value})
    assert getattr(limits, name) == value
    assert [other for other in NAMES if getattr(limits, other) != getattr(Limits(), other)] in (
        [name],
        [],
    )


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("value", [0, -1, math.inf, -math.inf, math.nan])
def test_a_limit_that_limits_nothing_or_everything_is_rejected(name: str, value: float) -> None:
    with pytest.raises(
        ValueError, match=f"^the limit of {name} must be finite and more than 0, not "
    ):
        Limits(**{name: value})  # type: ignore[arg-type]  # a float where some take an int


def test_messages_of_a_kibibyte_pass_everywhere() -> None:
    limits = Limits(frame=LEAST_FRAME)
    assert limits.frame == ClientSettings(limits=limits).max_frame
    with pytest.raises(ValueError, match=r"^the limit of frame must be between 1024 and 42949672"):
        Limits(frame=LEAST_FRAME - 1)
    with pytest.raises(ValueError, match="not 4294967296"):
        Limits(frame=2**32)


def test_limits_are_not_none() -> None:
    limits: Any = None
    with pytest.raises(TypeError, match=r"limits must be given as Limits\(.*, not None"):
        ClientSettings(limits=limits)


@pytest.mark.parametrize("name", ["frame", "goals"])
def test_a_limit_that_counts_is_a_whole_number(name: str) -> None:
    with pytest.raises(
        TypeError, match=f"^the limit of {name} must be a whole number, not 10000.0$"
    ):
        Limits(**{name: 1e4})  # type: ignore[arg-type]  # what a user may write

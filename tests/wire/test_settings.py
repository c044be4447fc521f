from __future__ import annotations

import math

import pytest
from hypothesis import given, strategies

from fibaction.wire.frames import MAX_FRAME
from fibaction.wire.settings import Limits

NAMES = Limits.__struct_fields__


def test_the_default_limits_let_a_usual_client_work() -> None:
    limits = Limits()
    assert limits.frame == MAX_FRAME
    assert limits.queue <= limits.frame <= limits.memory
    assert all(0 < getattr(limits, name) < math.inf for name in NAMES)


@given(strategies.sampled_from(NAMES), strategies.integers(1, 2**40))
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
    with pytest.raises(ValueError, match=f"^the limit of {name} is finite and more than 0, not "):
        Limits(**{name: value})  # type: ignore[arg-type]  # a float where some take an int


def test_a_fraction_of_a_second_is_time_for_a_handshake() -> None:
    assert Limits(handshake=0.25).handshake == 0.25


def test_limits_do_not_change() -> None:
    limits = Limits()
    with pytest.raises(AttributeError):
        limits.goals = 1  # type: ignore[misc]  # that is what is refused

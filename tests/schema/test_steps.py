from __future__ import annotations

from typing import Any

import pytest

from fibaction.schema.check import (
    FILLED,
    FILLED_PER_VALUE,
    STEPS,
    STEPS_PER_VALUE,
    TURN,
    CheckSteps,
    Extent,
    are_equal,
)
from fibaction.schema.json_schema import SchemaError


def test_the_size_of_data_counts_text_by_its_length() -> None:
    data = {"a": [1, b"x" * 1000], "b" * 500: "c" * 200}

    assert Extent.of(data) == (1 + 1 + 1 + 1 + 11 + 6 + 3, 2)
    assert Extent.of(None) == (1, 0)


def test_larger_data_may_take_more_steps() -> None:
    steps = CheckSteps(2)
    steps.spend(STEPS + 2 * STEPS_PER_VALUE)

    with pytest.raises(SchemaError, match="is too complex: a check by it takes over 20,100 steps"):
        steps.spend()


@pytest.mark.parametrize(
    ("one", "other", "is_equal"),
    [
        ({"a": [1, "b"]}, {"a": [1.0, "b"]}, True),
        ({"a": 1}, {"b": 1}, False),
        ([1], [1, 2], False),
        ([1, 2], [1, 3], False),
        (1, True, False),
        (True, True, True),
        ([], {}, False),
    ],
)
def test_values_are_equal_as_in_json(one: Any, other: Any, is_equal: bool) -> None:
    assert are_equal(CheckSteps(1), one, other) is is_equal


def test_the_comparison_of_long_text_takes_many_steps() -> None:
    with pytest.raises(SchemaError, match="is too complex"):
        are_equal(CheckSteps(1), "a" * 20_000_000, "b")


def test_a_check_pauses_after_each_turn() -> None:
    pauses: list[int] = []
    steps = CheckSteps(100, lambda: pauses.append(steps.spent))
    for _ in range(3 * TURN):
        steps.spend()

    assert pauses == [1, TURN + 2, 2 * TURN + 3]
    assert steps.spent == 3 * TURN


def test_larger_data_may_have_more_defaults() -> None:
    steps = CheckSteps(2)
    steps.fill(FILLED + 2 * FILLED_PER_VALUE)

    with pytest.raises(SchemaError, match="too many defaults: in this message they take over"):
        steps.fill(1)


def test_maps_are_compared_by_their_fields() -> None:
    assert not are_equal(CheckSteps(1), {"a": [1, 2]}, {"a": [1, 3]})

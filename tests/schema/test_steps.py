from __future__ import annotations

from typing import Any

import pytest

from fibaction.schema.json_schema import SchemaError
from fibaction.schema.steps import STEPS, STEPS_PER_VALUE, CheckSteps, Extent, are_equal


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

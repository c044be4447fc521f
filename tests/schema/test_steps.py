from __future__ import annotations

import pytest

from fibaction.schema.check import (
    FILLED,
    FILLED_PER_VALUE,
    STEPS,
    STEPS_PER_VALUE,
    TURN,
    CheckSteps,
    Extent,
    SchemaError,
    are_equal,
)


def test_the_size_of_data_counts_text_by_its_length() -> None:
    data = {"a": [1, b"x" * 1000], "b" * 500: "c" * 200}

    assert Extent.of(data) == (1 + 1 + 1 + 1 + 11 + 6 + 3, 2)
    assert Extent.of(None) == (1, 0)


def test_larger_data_may_take_more_steps() -> None:
    steps = CheckSteps(2)
    steps.spend(STEPS + 2 * STEPS_PER_VALUE)

    with pytest.raises(SchemaError, match="is too complex: a check by it takes over 20,100 steps"):
        steps.spend()


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

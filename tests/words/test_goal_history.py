"""`GoalHistory`: the bounds of a history."""

from __future__ import annotations

import math
from typing import Any

import pytest

from fibaction.words.goal_history import SECOND, GoalHistory, check_is_history


@pytest.mark.parametrize(
    ("fields", "error", "text"),
    [
        ({"seconds": 0}, ValueError, "seconds must be more than 0, not 0"),
        ({"seconds": math.nan}, ValueError, "seconds must be more than 0, not nan"),
        ({"seconds": "1"}, TypeError, "seconds must be a number, not '1'"),
        ({"goals": 0}, ValueError, "goals must be 1 or more, not 0"),
        ({"goals": 1.5}, TypeError, "goals must be a whole number, not 1.5"),
    ],
)
def test_bounds_are_checked(fields: dict[str, Any], error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        GoalHistory(**fields)


def test_an_end_is_too_long_ago_after_the_seconds_of_the_history() -> None:
    assert GoalHistory(seconds=2.5).earliest_end(10 * SECOND) == 7.5 * SECOND
    assert GoalHistory(seconds=math.inf).earliest_end(10 * SECOND) == -1


def test_what_is_not_a_history_is_a_type_error() -> None:
    check_is_history(None)
    check_is_history(GoalHistory())
    with pytest.raises(TypeError, match="history must be a GoalHistory, not 5"):
        check_is_history(5)

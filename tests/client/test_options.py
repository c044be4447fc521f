"""The arguments of an action's function, beside the options of a call."""

from __future__ import annotations

from typing import Any

import pytest

from fibaction import Action, action
from fibaction.client.options import CALL_OPTIONS, goal_of


@action
async def cook(minutes: int, timeout: float = 1.0) -> None: ...


PLAIN = Action("plain", goal=int, feedback=int, result=int)


def test_a_goal_is_made_of_arguments_or_stands_alone() -> None:
    made: Any = cook.goal_of(3)
    given: dict[str, Any] = {"minutes": 3}
    assert goal_of(cook, (3,), {}, CALL_OPTIONS) == goal_of(cook, (), given, CALL_OPTIONS) == made
    options: dict[str, Any] = {"timeout": 5.0}
    assert goal_of(cook, (made,), options, CALL_OPTIONS) is made
    assert goal_of(PLAIN, (3,), options, CALL_OPTIONS) == 3
    assert (given, options) == ({}, {"timeout": 5.0})


@pytest.mark.parametrize(
    ("called", "args", "options", "text"),
    [
        (cook, (3,), {"timeout": 2.0}, r"make the goal with `cook\.goal_of\(timeout=\.\.\.\)`"),
        (cook, (3,), {"timeout": None}, r"make the goal with `cook\.goal_of\(timeout=\.\.\.\)`"),
        (cook, (cook.goal_of(3), 2.0), {}, "is a whole goal of 'cook', and stands alone"),
        (PLAIN, (1, 2), {}, "is one value, and is given as one argument"),
    ],
)
def test_what_could_be_both_is_refused(
    called: Any, args: tuple[Any, ...], options: dict[str, Any], text: str
) -> None:
    with pytest.raises(TypeError, match=text):
        goal_of(called, args, options, CALL_OPTIONS)

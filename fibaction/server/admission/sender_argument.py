"""`with_sender`: functions of a goal that may take its sender as a second argument."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar, cast

from fibaction.words.goals import Sender

GoalT = TypeVar("GoalT")
AnswerT = TypeVar("AnswerT")

GoalFunction: TypeAlias = Callable[[GoalT], AnswerT] | Callable[[GoalT, Sender], AnswerT]
"""A function of a goal, or of a goal and its sender."""


def with_sender(
    name: str, function: GoalFunction[GoalT, AnswerT]
) -> Callable[[GoalT, Sender], AnswerT]:
    """Return a function of a goal and its sender that calls `function` with as much as it takes.

    It is decided here, once, by the signature: the sender is passed if the function cannot be
    called without a second argument.

    Raises:
        TypeError: `function` cannot be called with one argument nor with two; the error has `name`.
    """
    if _takes_sender(name, function):
        return cast("Callable[[GoalT, Sender], AnswerT]", function)
    of_goal = cast("Callable[[GoalT], AnswerT]", function)
    return lambda goal, _: of_goal(goal)


def _takes_sender(name: str, function: Callable[..., object]) -> bool:
    try:
        outer = inspect.signature(function, follow_wrapped=False)
        inner = inspect.signature(function)
    except ValueError:  # for example a function that is written in C
        return False
    except TypeError:
        raise _not_a_goal_function(name, function) from None
    if not (_accepts(outer, 1) or _accepts(outer, 2)):
        raise _not_a_goal_function(name, function)
    # A decorator often returns a function of any arguments, so that the wrapped one decides.
    return _accepts(outer, 2) and _accepts(inner, 2) and not _accepts(inner, 1)


def _accepts(signature: inspect.Signature, count: int) -> bool:
    """Return whether a function of that signature can be called with so many arguments."""
    try:
        signature.bind(*[None] * count)
    except TypeError:
        return False
    return True


def _not_a_goal_function(name: str, function: Any) -> TypeError:
    return TypeError(
        f"{name} is a function of a goal, or of a goal and its sender, not {function!r}"
    )

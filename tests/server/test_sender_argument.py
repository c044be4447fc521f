"""Functions of a goal, or of a goal and its sender."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, wraps
from typing import Any

import pytest

from fibaction import ActionServer
from fibaction.server.admission.sender_argument import with_sender
from fibaction.words.goals import Sender
from tests.support.fibonacci import FIBONACCI, fibonacci

ANN = Sender("ann")


def of_goal(goal: Any) -> Any:
    return goal, None


def of_both(goal: Any, sender: Any) -> Any:
    return goal, sender


def of_three(goal: Any, sender: Any, more: Any) -> Any:
    raise AssertionError("it is not called")


def of_none() -> Any:
    raise AssertionError("it is not called")


def with_default(goal: Any, sender: Any = None) -> Any:
    return goal, sender


def with_keyword(goal: Any, *, sender: Any) -> Any:
    raise AssertionError("it is not called")


class Policy:
    def of_goal(self, goal: Any) -> Any:
        return goal, None

    def of_both(self, goal: Any, sender: Any) -> Any:
        return goal, sender

    async def __call__(self, goal: Any, sender: Any) -> Any:
        return goal, sender


def wrapped(function: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        return function(*args, **kwargs)

    return call


def with_another(function: Callable[..., Any]) -> Callable[..., Any]:
    """A decorator that supplies an argument, as those do that inject dependencies."""

    @wraps(function)
    def call(goal: Any) -> Any:
        return function(goal, None)

    return call


class Methods:
    @wrapped
    def of_both(self, goal: Any, sender: Any) -> Any:
        return goal, sender


@pytest.mark.parametrize(
    "function",
    [
        of_both,
        lambda goal, sender: (goal, sender),
        lambda goal, sender, more=None: (goal, sender),
        Policy().of_both,
        partial(with_default, sender=ANN),
        partial(lambda limit, goal, sender: (goal, sender), 10),
        wrapped(of_both),
        Methods().of_both,
    ],
)
def test_a_function_that_needs_two_arguments_gets_the_sender(function: Any) -> None:
    assert with_sender("key", function)("goal", ANN) == ("goal", ANN)


@pytest.mark.parametrize(
    "function",
    [
        of_goal,
        lambda goal: (goal, None),
        lambda goal=None: (goal, None),
        with_default,
        lambda *args: (*args, None),
        Policy().of_goal,
        partial(of_both, sender=None),
        partial(with_default),
        wrapped(of_goal),
        with_another(of_both),
    ],
)
def test_any_other_function_gets_the_goal_alone(function: Any) -> None:
    assert with_sender("key", function)("goal", ANN) == ("goal", None)


@pytest.mark.asyncio
async def test_an_object_with_an_async_call_gets_the_sender() -> None:
    assert await with_sender("key", Policy())("goal", ANN) == ("goal", ANN)


def test_a_function_whose_signature_cannot_be_read_gets_the_goal_alone() -> None:
    smallest: Any = min
    assert with_sender("key", smallest)([2, 1], ANN) == 1


@pytest.mark.parametrize("function", [of_none, of_three, with_keyword, "of_goal"])
def test_what_takes_neither_one_argument_nor_two_is_an_error(function: Any) -> None:
    with pytest.raises(TypeError) as caught:
        with_sender("key", function)
    text = f"key is a function of a goal, or of a goal and its sender, not {function!r}"
    assert str(caught.value) == text


def test_a_server_says_at_once_that_its_on_goal_cannot_be_called() -> None:
    on_goal: Any = of_three
    with pytest.raises(TypeError, match=r"^on_goal is a function of a goal, or of a goal and its"):
        ActionServer(FIBONACCI, fibonacci, on_goal=on_goal)

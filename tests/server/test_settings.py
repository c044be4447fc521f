"""What cannot be given to an `ActionServer` is told at once, with what to do."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from functools import partial
from typing import Any, cast

import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionInfo,
    ActionServer,
    GoalHandle,
)
from tests.support.executors import Items
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci

pytestmark = pytest.mark.anyio


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"feedback": "some"}, "feedback must be 'every' or 'latest', not 'some'"),
        ({"feedback_window": 0}, "feedback_window must be at least 1, not 0"),
        ({"stall_timeout": -1}, "stall_timeout must be 0 or more, not -1"),
        ({"result_timeout": -0.1}, "result_timeout must be 0 or more, not -0.1"),
        ({"result_timeout": math.nan}, "result_timeout must be 0 or more, not nan"),
        ({"max_results": -1}, "max_results must be 0 or more, not -1"),
        ({"max_goals": -1}, "max_goals must be 0 or more, not -1"),
        ({"max_bytes": -1}, "max_bytes must be 0 or more, not -1"),
        ({"shutdown_timeout": -1}, "shutdown_timeout must be 0 or more, not -1"),
        ({"watchdog": -1}, "watchdog must be 0 or more, not -1"),
        ({"watchdog": math.nan}, "watchdog must be 0 or more, not nan"),
        ({"recovery": "again"}, "recovery must be 'abort', 'rerun' or a function, not 'again'"),
        ({"max_attempts": 0}, "max_attempts must be at least 1, not 0"),
        ({"at_stop": "run"}, "at_stop must be 'abort' or 'keep', not 'run'"),
        ({"unreadable": "run"}, "unreadable must be 'refuse' or 'abort', not 'run'"),
    ],
)
def test_an_option_out_of_range_is_rejected_at_once(options: Any, text: str) -> None:
    with pytest.raises(ValueError, match="^" + text + "$"):
        ActionServer(FIBONACCI, fibonacci, **options)


async def returns(goal: GoalHandle[Goal]) -> Result:
    return Result([])


def without_async(goal: GoalHandle[Goal]) -> Iterator[Feedback | Result]:
    yield Result([])


class Returns:
    async def __call__(self, goal: GoalHandle[Goal]) -> Result:
        return Result([])


class WithoutAsync:
    def method(self, goal: GoalHandle[Goal]) -> Iterator[Feedback | Result]:
        yield Result([])


COROUTINE = (
    "a coroutine function: yield its feedback, and yield its result last, instead of returning it,"
    " or make an action of it with @action"
)
NOT_ASYNC = "a generator function that is not async: write `async def`, and await what takes time"


@pytest.mark.parametrize(
    ("executor", "name", "what"),
    [
        (returns, "returns", COROUTINE),
        (partial(returns), "returns", COROUTINE),
        (partial(partial(Returns())), "Returns", COROUTINE),
        (without_async, "without_async", NOT_ASYNC),
        (WithoutAsync().method, "method", NOT_ASYNC),
    ],
)
def test_a_function_that_is_no_async_generator_is_rejected_with_what_to_do(
    executor: Any, name: str, what: str
) -> None:
    with pytest.raises(TypeError) as caught:
        ActionServer(FIBONACCI, executor)
    assert str(caught.value) == f"the executor {name!r} is {what}"


def annotated(goal: Any) -> str:
    return f"at {goal}"


def unknown(goal: Any) -> Hidden:  # type: ignore[name-defined]  # noqa: F821  # as behind TYPE_CHECKING
    return fibonacci(goal)


def test_a_function_of_a_type_that_cannot_be_read_may_be_an_executor() -> None:
    assert ActionServer(FIBONACCI, unknown).is_new


def test_a_function_that_says_that_it_returns_its_result_is_rejected_at_once() -> None:
    executor: Any = annotated
    with pytest.raises(TypeError, match="is not an async generator function, and returns its resu"):
        ActionServer(FIBONACCI, executor)


@pytest.mark.parametrize(
    ("first", "hint"),
    [
        (fibonacci, "write ActionServer(action, fibonacci), the executor last"),
        ("fibonacci", "write ActionServer(action, executor)"),
    ],
)
def test_arguments_in_the_wrong_order_are_told_in_one_sentence(first: Any, hint: str) -> None:
    with pytest.raises(TypeError, match=f"first argument of .* not .*: {re.escape(hint)}"):
        ActionServer(first, cast("Any", FIBONACCI))


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"shutdown_timeout": "5"}, "shutdown_timeout must be a number, not '5'"),
        ({"store": "goals.db"}, "store must be a GoalStore, such as SqliteStore"),
        ({"schedule": {"total": 1}}, "schedule must be a Schedule, not {'total': 1}"),
    ],
)
def test_a_setting_of_another_type_is_told_in_one_sentence(options: Any, text: str) -> None:
    with pytest.raises(TypeError, match=text):
        ActionServer(FIBONACCI, fibonacci, **options)


@pytest.mark.parametrize("executor", [3, "fibonacci", Goal(1)])
def test_what_cannot_be_called_is_no_executor(executor: Any) -> None:
    with pytest.raises(TypeError) as caught:
        ActionServer(FIBONACCI, executor)
    assert str(caught.value) == (
        f"the executor is an async generator function, and not {executor!r}"
    )


class Calls:
    def __call__(self, goal: GoalHandle[Goal]) -> Items:
        return fibonacci(goal)

    async def method(self, more: int, goal: GoalHandle[Goal]) -> Items:
        yield Result([more])


@pytest.mark.parametrize(
    "executor",
    [Calls(), partial(Calls().method, 0), partial(Calls()), lambda goal: fibonacci(goal)],
    ids=["an object", "part of a method", "part of an object", "a lambda"],
)
async def test_whatever_gives_an_async_generator_is_an_executor(executor: Any) -> None:
    async with ActionServer(FIBONACCI, executor) as server:
        client = ActionClient(server, FIBONACCI)
        assert await client.call(Goal(0)) == Result([0])


def test_a_setting_that_there_is_not_is_named_with_the_one_that_was_meant() -> None:
    meant = "ActionServer has no setting 'stall_timout': did you mean 'stall_timeout'?"
    with pytest.raises(TypeError, match=re.escape(meant)):
        ActionServer(FIBONACCI, fibonacci, stall_timout=1)  # type: ignore[call-arg]  # on purpose


def test_an_action_without_types_cannot_be_executed() -> None:
    with pytest.raises(TypeError, match="is untyped, and a server needs types"):
        ActionServer(Action.untyped(ActionInfo("x")), fibonacci)

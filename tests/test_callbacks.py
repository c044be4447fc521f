from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable
from typing import Any

import anyio
import pytest

from fibaction.callbacks import SERVER_STOPPING, Callbacks
from fibaction.exceptions import CancelRejected, GoalRejected

pytestmark = pytest.mark.asyncio

Refusal = type[GoalRejected] | type[CancelRejected]
each_refusal = pytest.mark.parametrize("refusal", [GoalRejected, CancelRejected])


def as_async(callback: Callable[[Any], Any]) -> Callable[[Any], Awaitable[Any]]:
    async def waiting(argument: Any) -> Any:
        await anyio.lowlevel.checkpoint()
        return callback(argument)

    return waiting


def as_given(callback: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return callback


each_colour = pytest.mark.parametrize("colour", [as_given, as_async], ids=["sync", "async"])
Colour = Callable[[Callable[[Any], Any]], Callable[[Any], Any]]


async def ask(
    callback: Callable[[Any], Any], refusal: Refusal = GoalRejected, argument: Any = None
) -> None:
    with anyio.fail_after(5):
        await Callbacks("arm").ask("on_goal", callback, argument, refusal)


@each_colour
async def test_a_callback_that_returns_none_agrees_and_gets_the_argument(colour: Colour) -> None:
    seen: list[str] = []
    await ask(colour(seen.append), argument="a goal")
    assert seen == ["a goal"]


@each_refusal
@each_colour
async def test_a_callback_refuses_with_its_own_error(
    colour: Colour, refusal: Refusal, caplog: pytest.LogCaptureFixture
) -> None:
    said = refusal("too far")

    def refuse(argument: Any) -> None:
        raise said

    with pytest.raises(refusal) as caught:
        await ask(colour(refuse), refusal)
    assert caught.value is said
    assert caplog.records == []


@each_refusal
@each_colour
async def test_a_callback_that_fails_refuses_and_leaves_its_traceback_in_the_log(
    colour: Colour, refusal: Refusal, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(argument: Any) -> None:
        raise LookupError("no map")

    with pytest.raises(refusal) as caught:
        await ask(colour(fail), refusal)
    assert caught.value.reason == "on_goal failed: LookupError: no map"
    assert isinstance(caught.value.__cause__, LookupError)
    (record,) = caplog.records
    assert (record.name, record.levelno) == ("fibaction.server", logging.ERROR)
    assert record.getMessage() == "action 'arm': on_goal failed: LookupError: no map"
    assert record.exc_info is not None
    assert record.exc_info[1] is caught.value.__cause__


@each_colour
async def test_the_other_refusal_is_a_failure(colour: Colour) -> None:
    def refuse(argument: Any) -> None:
        raise CancelRejected("no")

    with pytest.raises(GoalRejected) as caught:
        await ask(colour(refuse), GoalRejected)
    assert caught.value.reason == "on_goal failed: CancelRejected: no"


@pytest.mark.parametrize("answer", [True, False, "yes"])
@each_colour
async def test_a_callback_that_returns_something_refuses_and_says_what_to_do(
    colour: Colour, answer: object
) -> None:
    with pytest.raises(GoalRejected) as caught:
        await ask(colour(lambda argument: answer))
    assert caught.value.reason == (
        f"on_goal failed: TypeError: on_goal returned {answer!r}: return None to agree,"
        " raise GoalRejected(reason) to refuse"
    )


@each_colour
async def test_what_ends_python_itself_is_let_through(
    colour: Colour, caplog: pytest.LogCaptureFixture
) -> None:
    class Ending(BaseException):
        pass

    def end(argument: Any) -> None:
        raise Ending

    with pytest.raises(Ending):
        await ask(colour(end))
    assert caplog.records == []


@each_refusal
async def test_stopping_refuses_what_is_still_being_asked(
    refusal: Refusal, caplog: pytest.LogCaptureFixture
) -> None:
    callbacks = Callbacks("arm")
    reasons: list[str] = []
    cleaned_up: list[str] = []

    async def wait_for_ever(argument: str) -> None:
        try:
            await anyio.sleep_forever()
        finally:
            cleaned_up.append(argument)

    async def ask(argument: str) -> None:
        with pytest.raises(refusal) as caught:
            await callbacks.ask("on_goal", wait_for_ever, argument, refusal)
        reasons.append(caught.value.reason)

    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(ask, "one")
            tasks.start_soon(ask, "other")
            await anyio.wait_all_tasks_blocked()
            assert reasons == []
            callbacks.stop()
    assert reasons == [SERVER_STOPPING] * 2
    assert sorted(cleaned_up) == ["one", "other"]
    assert caplog.records == []


async def test_stopping_does_not_touch_what_was_answered_before() -> None:
    callbacks = Callbacks("arm")
    with anyio.fail_after(5):
        await callbacks.ask("on_goal", as_async(lambda argument: None), None, GoalRejected)
        # Or it would grow with every goal.
        assert not callbacks._waiting
        callbacks.stop()
        await anyio.lowlevel.checkpoint()


async def test_a_callback_that_answers_in_spite_of_the_stop_has_answered() -> None:
    callbacks = Callbacks("arm")
    answered = anyio.Event()

    async def answer_at_last(argument: None) -> None:
        try:
            await anyio.sleep_forever()
        except anyio.get_cancelled_exc_class():
            raise GoalRejected("the arm is folded") from None

    async def ask() -> None:
        with pytest.raises(GoalRejected, match="the arm is folded"):
            await callbacks.ask("on_goal", answer_at_last, None, GoalRejected)
        answered.set()

    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(ask)
            await anyio.wait_all_tasks_blocked()
            callbacks.stop()
    assert answered.is_set()


async def test_a_caller_who_is_canceled_is_not_told_that_the_server_stops() -> None:
    callbacks = Callbacks("arm")

    async def wait_for_ever(argument: None) -> None:
        await anyio.sleep_forever()

    with anyio.fail_after(5):
        with anyio.CancelScope() as caller:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(callbacks.ask, "on_goal", wait_for_ever, None, GoalRejected)
                await anyio.wait_all_tasks_blocked()
                caller.cancel()
        assert caller.cancelled_caught
        # Nothing is left behind that a later stop would reach.
        callbacks.stop()
        await anyio.lowlevel.checkpoint()

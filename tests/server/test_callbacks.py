from __future__ import annotations

import asyncio  # noqa: TID251  # it alone can cancel a task from outside
from collections.abc import Awaitable, Callable, Coroutine, Generator
from functools import partial
from typing import Any

import anyio
import pytest

from fibaction import ActionServer, GoalHandle, GoalID, GoalStatus
from fibaction.server.admission.callbacks import CANCELED_ELSEWHERE, SERVER_STOPPING, GoalCallbacks
from fibaction.server.settings import ActionServerSettings
from fibaction.words.errors import CancelRejected, GoalRejected
from tests.server.held import waits
from tests.support.fibonacci import FIBONACCI, Goal, fibonacci

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


def callbacks_of_an_arm() -> GoalCallbacks[Any]:
    return GoalCallbacks("arm", ActionServerSettings())


def waited_for(asking: Coroutine[Any, Any, None] | None) -> Coroutine[Any, Any, None]:
    """What there is to wait for, of a callback that has to be waited for."""
    assert asking is not None
    return asking


async def ask(
    callback: Callable[[Any], Any], refusal: Refusal = GoalRejected, argument: Any = None
) -> None:
    with anyio.fail_after(5):
        asking = callbacks_of_an_arm().ask("on_goal", callback, (argument,), refusal)
        if asking is not None:
            await asking


def agrees(argument: Any) -> None:
    """A callback that has nothing against it."""


class Promise:
    """An awaitable that is no coroutine, as a future is none."""

    def __init__(self, event: anyio.Event, answer: object = None) -> None:
        self._event = event
        self._answer = answer

    def __await__(self) -> Generator[Any, Any, Any]:
        yield from self._event.wait().__await__()
        return self._answer


@each_refusal
@each_colour
async def test_a_callback_that_awaits_a_canceled_task_rejects(
    colour: Colour, refusal: Refusal, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(argument: Any) -> None:
        raise anyio.get_cancelled_exc_class()

    with pytest.raises(refusal) as caught:
        await ask(colour(fail), refusal)
    text = "on_goal failed: RuntimeError: it awaited a task or future that was canceled elsewhere"
    assert caught.value.reason == text
    assert text in caplog.text


@each_refusal
async def test_stopping_rejects_what_is_still_being_asked(
    refusal: Refusal, caplog: pytest.LogCaptureFixture
) -> None:
    callbacks = callbacks_of_an_arm()
    reasons: list[str] = []
    cleaned_up: list[str] = []

    async def wait_for_ever(argument: str) -> None:
        try:
            await anyio.sleep_forever()
        finally:
            cleaned_up.append(argument)

    async def ask(argument: str) -> None:
        with pytest.raises(refusal) as caught:
            await waited_for(callbacks.ask("on_goal", wait_for_ever, (argument,), refusal))
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


@each_refusal
@pytest.mark.parametrize("promises", [False, True], ids=["a coroutine", "an awaitable"])
async def test_stopping_rejects_also_a_question_that_is_not_awaited_yet(
    refusal: Refusal, promises: bool
) -> None:
    callbacks = callbacks_of_an_arm()

    async def wait_for_ever(argument: None) -> None:
        await anyio.sleep_forever()

    def promise(argument: None) -> Promise:
        return Promise(anyio.Event())

    callback = promise if promises else wait_for_ever
    asking = waited_for(callbacks.ask("on_goal", callback, (None,), refusal))
    callbacks.stop()
    with anyio.fail_after(5):
        with pytest.raises(refusal, match=SERVER_STOPPING):
            await asking


async def test_stopping_does_not_touch_what_was_answered_before() -> None:
    callbacks = callbacks_of_an_arm()
    with anyio.fail_after(5):
        await waited_for(callbacks.ask("on_goal", as_async(agrees), (None,), GoalRejected))
        # Or it would grow with every goal.
        assert not callbacks._waiting
        callbacks.stop()
        await anyio.lowlevel.checkpoint()


async def test_a_caller_that_is_canceled_is_not_told_that_the_server_stops() -> None:
    callbacks = callbacks_of_an_arm()

    async def wait_for_ever(argument: None) -> None:
        await anyio.sleep_forever()

    async def ask() -> None:
        await waited_for(callbacks.ask("on_goal", wait_for_ever, (None,), GoalRejected))

    with anyio.fail_after(5):
        with anyio.CancelScope() as caller:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(ask)
                await anyio.wait_all_tasks_blocked()
                caller.cancel()
        assert caller.cancelled_caught
        # Nothing is left behind that a later stop would reach.
        callbacks.stop()
        await anyio.lowlevel.checkpoint()


async def test_a_caller_whose_own_task_is_canceled_is_not_rejected() -> None:
    callbacks = callbacks_of_an_arm()

    async def wait_for_ever(argument: None) -> None:
        await anyio.sleep_forever()

    asking = asyncio.create_task(
        waited_for(callbacks.ask("on_goal", wait_for_ever, (None,), GoalRejected))
    )
    await anyio.wait_all_tasks_blocked()
    asking.cancel()
    with anyio.fail_after(5), pytest.raises(asyncio.CancelledError):
        await asking


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
async def test_a_cancellation_from_elsewhere_is_a_failure_on_each_backend(backend: str) -> None:
    async def raise_an_old_one(argument: None) -> None:
        with anyio.CancelScope() as scope:
            scope.cancel()
            try:
                await anyio.sleep_forever()
            except anyio.get_cancelled_exc_class() as exc:
                old = exc
        raise old

    async def main() -> None:
        with pytest.raises(GoalRejected) as caught:
            await ask(raise_an_old_one)
        assert caught.value.reason == f"on_goal failed: RuntimeError: {CANCELED_ELSEWHERE}"

    # In a thread, as this one has a loop of asyncio's.
    await anyio.to_thread.run_sync(partial(anyio.run, main, backend=backend))


# Callbacks that act upon the goal that they decide upon


def goal_of(order: int) -> bytes:
    return FIBONACCI.goal.encode(Goal(order))


@pytest.mark.parametrize("act", ["cancels", "sends again"])
@pytest.mark.parametrize("by_a_task", [False, True], ids=["itself", "by a task"])
async def test_an_on_goal_that_would_wait_for_itself_rejects_and_says_so(
    act: str, by_a_task: bool, caplog: pytest.LogCaptureFixture
) -> None:
    goal_id = GoalID.random()

    async def wait_for_itself() -> None:
        if act == "cancels":
            await server.cancel_goals(goal_id)
        else:
            await server.send_goal(goal_id, goal_of(1))

    async def on_goal(goal: Goal) -> None:
        await server.cancel_goals()  # all goals that are accepted
        await server.cancel_goals(GoalID.random())
        if by_a_task:
            await asyncio.create_task(wait_for_itself())
        else:
            await wait_for_itself()

    with anyio.fail_after(5):
        async with ActionServer(FIBONACCI, fibonacci, on_goal=on_goal) as server:
            with pytest.raises(GoalRejected) as caught:
                await server.send_goal(goal_id, goal_of(1))
    text = "on_goal cancels, or sends again, the goal that it decides upon, and would wait for"
    assert f"on_goal failed: RuntimeError: {text} itself: do it after on_goal" in (
        caught.value.reason
    )
    assert text in caplog.text


async def test_an_on_cancel_that_cancels_its_goal_again_rejects_and_says_so() -> None:
    async def on_cancel(goal: GoalHandle[Goal]) -> None:
        await server.cancel_goals(goal.goal_id)

    with anyio.fail_after(5):
        async with ActionServer(FIBONACCI, waits, on_cancel=on_cancel) as server:
            stream = await server.send_goal(GoalID.random(), goal_of(1))
            answer = await server.cancel_goals(stream.goal_id)
            assert "on_cancel cancels the goal that it decides upon" in answer.reason
            assert stream.status is not GoalStatus.CANCELING

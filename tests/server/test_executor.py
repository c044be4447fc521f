"""`fibaction.server.execution.executor` alone: an `Execution` with no server around it."""

from __future__ import annotations

import gc
import logging
import math
from collections.abc import Awaitable, Callable
from typing import Any, cast
from weakref import ref

import anyio
import pytest
from anyio.lowlevel import checkpoint

from fibaction import GoalAborted, GoalCanceled, GoalHandle, GoalID, GoalStatus
from fibaction.feeds.feedback_log import FeedbackLog
from fibaction.server.durability.keeper import Keeper
from fibaction.server.execution.executor import Execution, Executor
from fibaction.server.execution.interruption import CancelOnce
from fibaction.server.execution.watchdog import Watch
from fibaction.server.functions.executor_check import runner_of
from fibaction.server.goal_handle import Succession
from fibaction.server.registry.goal_record import Ending, EndKind, GoalRecord
from fibaction.words.goals import UNKNOWN_SENDER
from fibaction.words.statuses import GoalEvent, transition
from tests.support.executors import FORMS, Items, as_function
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result

NO_CHECKPOINTS = Keeper("fibonacci")

pytestmark = pytest.mark.anyio


@pytest.fixture(params=FORMS, autouse=True)
def form(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Run each test for both forms of executors."""
    monkeypatch.setattr(Bench, "form", request.param)
    return str(request.param)


class Bench:
    """An execution, and what it needs to run."""

    form = "generator"

    def __init__(
        self,
        executor: Executor[Goal, Feedback, Result],
        order: int = 3,
        *,
        window: int = 1000,
        stall_timeout: float = math.inf,
    ) -> None:
        self.goal = GoalRecord(GoalID.random(), b"", 1, UNKNOWN_SENDER)
        self.goal.status = GoalStatus.EXECUTING
        self.log = FeedbackLog(self.goal, window=window)
        self.stream = self.log.follow(own=True)
        handle = GoalHandle(
            self.goal,
            Goal(order),
            NO_CHECKPOINTS,
            Succession(),
        )
        if self.form == "function":
            executor = as_function(cast("Any", executor))
        self.execution = Execution(
            FIBONACCI,
            runner_of(executor),
            handle,
            self.log,
            stall_timeout,
            Watch(FIBONACCI.name, 0),
        )
        self.ending: Ending | None = None

    async def run(self) -> Ending:
        scopes = CancelOnce(lambda: None)
        with anyio.CancelScope() as scope, scopes.rest, anyio.fail_after(5):
            scopes.run_by(scope)
            self.ending = await self.execution.run(scopes)
        assert self.ending is not None
        return self.ending

    def cancel(self) -> None:
        self.goal.status = transition(self.goal.status, GoalEvent.CANCEL_GOAL)
        self.execution.interrupt()

    async def run_and(self, meanwhile: Callable[[], Awaitable[None]]) -> Ending:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self.run)
            await anyio.wait_all_tasks_blocked()
            await meanwhile()
        assert self.ending is not None
        return self.ending

    async def run_and_cancel(self) -> Ending:
        async def cancel() -> None:
            self.cancel()

        return await self.run_and(cancel)

    async def read(self) -> list[int]:
        seen = []
        while self.stream.cursor < self.log.count:
            item = await self.stream.receive()
            assert item is not None
            seen.append(FIBONACCI.feedback.decode(item.payload).partial_sequence[-1])
        return seen


def packed(sequence: list[int]) -> bytes:
    return FIBONACCI.result.encode(Result(sequence))


@pytest.mark.parametrize("error", [GoalAborted, GoalCanceled])
async def test_the_error_of_another_goal_that_passes_through_keeps_its_reason(
    error: type[GoalAborted] | type[GoalCanceled], caplog: pytest.LogCaptureFixture
) -> None:
    async def passes_on(goal: GoalHandle[Goal]) -> Items:
        raise error("half", result={"of": "another type"}, goal_id=goal.goal_id)
        yield Result([])

    ending = await Bench(passes_on).run()
    reason = "half (its result is left out: a dict is not Result)"
    kind = EndKind.FAILED if error is GoalAborted else EndKind.CANCELED
    assert ending == Ending(kind, None, reason)
    assert f"{error.__name__}: {reason}" in caplog.text


@pytest.mark.parametrize("said", [RuntimeError, SystemExit])
async def test_an_error_that_cannot_say_what_it_is_ends_its_goal_alone(
    said: type[BaseException],
) -> None:
    class Mute(TypeError):
        def __str__(self) -> str:
            raise said

    async def raises(goal: GoalHandle[Goal]) -> Items:
        raise Mute
        yield Result([])

    assert await Bench(raises).run() == Ending(EndKind.FAILED, None, "Mute")


async def is_stuck(goal: GoalHandle[Goal]) -> Items:
    yield Feedback([1])
    raise ValueError("the arm is stuck")


async def never_awaits(goal: GoalHandle[Goal]) -> Items:
    while True:
        yield Feedback([1])


@pytest.mark.parametrize("executor", [is_stuck, never_awaits])
async def test_what_went_wrong_keeps_nothing_of_its_goal(
    executor: Executor[Goal, Feedback, Result], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.CRITICAL, logger="fibaction.server")  # what is logged is kept here

    async def log_of_one() -> ref[FeedbackLog[GoalRecord]]:
        bench = Bench(executor)
        await bench.run_and_cancel()
        bench.stream.close()
        del bench.execution  # its handle and the bench hold each other
        return ref(bench.log)

    gc.disable()  # so that only what nobody holds goes
    try:
        log = await log_of_one()
        await checkpoint()
        assert log() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("anyio_backend", ["asyncio"])  # for trio see `interruption`
async def test_shielded_clean_up_inside_a_task_group_keeps_no_cancellation_back() -> None:
    cleaned = []

    async def delegates(goal: GoalHandle[Goal]) -> Items:
        with anyio.move_on_after(60):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(anyio.sleep_forever)
                try:
                    await anyio.sleep_forever()
                finally:
                    with anyio.CancelScope(shield=True):
                        await checkpoint()
                    cleaned.append(1)
        yield Result([])

    assert await Bench(delegates).run_and_cancel() == Ending(EndKind.CANCELED)
    assert cleaned == [1]


@pytest.mark.parametrize("anyio_backend", ["asyncio"])  # on trio it may be taken for a nursery's
async def test_a_timeout_within_the_clean_up_ends_there() -> None:
    async def retreats(goal: GoalHandle[Goal]) -> Items:
        try:
            await anyio.sleep_forever()
        except anyio.get_cancelled_exc_class():
            with anyio.move_on_after(0.001) as patience:
                await anyio.sleep_forever()
            assert patience.cancelled_caught
            await checkpoint()
            raise GoalCanceled(result=Result([1])) from None
        yield Result([])

    assert await Bench(retreats).run_and_cancel() == Ending(EndKind.CANCELED, packed([1]))


async def test_a_group_of_cancellations_is_a_cancellation() -> None:
    async def groups(goal: GoalHandle[Goal]) -> Items:
        try:
            await anyio.sleep_forever()
        except anyio.get_cancelled_exc_class() as exc:
            raise BaseExceptionGroup("all of it", [exc]) from None
        yield Result([])

    assert await Bench(groups).run_and_cancel() == Ending(EndKind.CANCELED)


async def test_what_goes_wrong_beside_a_cancellation_is_what_went_wrong() -> None:
    async def groups(goal: GoalHandle[Goal]) -> Items:
        try:
            await anyio.sleep_forever()
        except anyio.get_cancelled_exc_class() as exc:
            raise BaseExceptionGroup("all of it", [exc, ValueError("the brake")]) from None
        yield Result([])

    assert await Bench(groups).run_and_cancel() == Ending(
        EndKind.FAILED, None, "ValueError: the brake"
    )


async def test_an_interruption_before_the_start_arrives_at_the_first_await() -> None:
    async def waits(goal: GoalHandle[Goal]) -> Items:
        await anyio.sleep_forever()
        yield Result([])

    bench = Bench(waits)
    bench.cancel()
    assert await bench.run() == Ending(EndKind.CANCELED)


# The first mistakes


@pytest.mark.parametrize(
    ("request_", "name", "hint"),
    [
        (Goal(3), "order", ": what the client sent is goal.request, so write goal.request.order"),
        (
            {"order": 3},
            "order",
            ": what the client sent is goal.request, so write goal.request['order']",
        ),
        (Goal(3), "ordr", ""),
        ({"order": 3}, "ordr", ""),
        (Goal(3), "__len__", ""),
    ],
)
def test_a_field_of_the_goal_is_looked_for_in_the_request(
    request_: Any, name: str, hint: str
) -> None:
    record = GoalRecord(GoalID.random(), b"", 1, UNKNOWN_SENDER)
    handle: GoalHandle[Any] = GoalHandle(record, request_, NO_CHECKPOINTS, Succession())
    with pytest.raises(AttributeError) as caught:
        getattr(handle, name)
    assert str(caught.value) == f"a GoalHandle has no attribute {name!r}{hint}"

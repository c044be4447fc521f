"""`fibaction.server.scheduling.goal_dispatcher`: a schedule in a server, beside the contract
suite."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Generator
from contextlib import asynccontextmanager, suppress
from types import SimpleNamespace
from typing import Any

import anyio
import pytest
from anyio.lowlevel import checkpoint

from fibaction import (
    ActionServer,
    GoalCanceled,
    GoalHandle,
    GoalID,
    GoalRejected,
    GoalStatus,
    Schedule,
)
from fibaction.border.abc import GoalStream
from fibaction.server.durability.keeper import Keeper
from fibaction.server.scheduling import goal_dispatcher
from fibaction.server.scheduling.dispatcher import Dispatcher
from tests.server.held import packed
from tests.support.executors import Items
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result
from tests.support.matching import End
from tests.support.virtual_time import in_virtual_time

pytestmark = pytest.mark.anyio


PREEMPTING = Schedule(concurrency=1, when_full="preempt")
HANDING_OVER = Schedule(concurrency=1, when_full="preempt", handover=math.inf)


def result(order: int) -> bytes:
    return FIBONACCI.result.encode(Result([order]))


class Arm:
    """An executor that works on each goal until it is told to go on, one step after another."""

    def __init__(self) -> None:
        self.begun: list[int] = []
        self.handles: dict[int, GoalHandle[Goal]] = {}
        self._changed = anyio.Event()
        self._may_end: dict[int, anyio.Event] = {}

    async def __call__(self, goal: GoalHandle[Goal]) -> Items:
        self.begin(goal)
        await self.end_of(goal.request.order)
        yield Result([goal.request.order])

    def begin(self, goal: GoalHandle[Goal]) -> None:
        """Note that the executor of a goal has begun."""
        self.begun.append(goal.request.order)
        self.handles[goal.request.order] = goal
        self._changed.set()
        self._changed = anyio.Event()

    async def until_begun(self, order: int) -> GoalHandle[Goal]:
        """Wait for the start of a goal, and return its handle."""
        while order not in self.handles:
            await self._changed.wait()
        return self.handles[order]

    def let_end(self, order: int) -> None:
        """Let a goal end with its result."""
        self._may_end.setdefault(order, anyio.Event()).set()

    async def end_of(self, order: int) -> None:
        """Wait for `let_end`."""
        await self._may_end.setdefault(order, anyio.Event()).wait()


class Server:
    """A server with a schedule, to which goals of different orders are sent."""

    def __init__(self, server: ActionServer[Goal, Feedback, Result]) -> None:
        self.server = server
        self._ids: dict[int, GoalID] = {}

    def id_of(self, order: int) -> GoalID:
        return self._ids.setdefault(order, GoalID.random())

    async def send(self, order: int, timeout: float | None = None) -> GoalStream:
        return await self.server.send_goal(self.id_of(order), packed(order), timeout=timeout)

    async def cancel(self, order: int) -> None:
        answer = await self.server.cancel_goals(self.id_of(order))
        assert [info.goal_id for info in answer.goals_canceling] == [self.id_of(order)]

    def preempted_by(self, order: int) -> str:
        return f"preempted by {self.id_of(order)}"


@asynccontextmanager
async def serving(
    schedule: Schedule, executor: Any, **settings: Any
) -> AsyncGenerator[Server, None]:
    """Run a server."""
    async with ActionServer(FIBONACCI, executor, schedule=schedule, **settings) as server:
        yield Server(server)


async def settled() -> None:
    """Let all other tasks run until they wait."""
    await anyio.wait_all_tasks_blocked()


# Waiting


@in_virtual_time()
async def test_very_many_goals_that_have_waited_too_long_are_ended_in_several_turns(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(goal_dispatcher, "ORDERS_IN_A_TURN", 10)
    arm = Arm()
    async with serving(Schedule(concurrency=1, queue=100, queue_timeout=3), arm) as site:
        await site.send(0)
        streams = [await site.send(order) for order in range(1, 101)]
        await anyio.sleep_until(anyio.current_time() + 3)
        counts = {0}
        while 100 not in counts:
            counts.add(sum(stream.status.is_terminal for stream in streams))
            await checkpoint()
        assert {(await stream.outcome()).reason for stream in streams} == {"waited for 3 s"}
    assert len(counts) > 5
    assert arm.begun == [0]


@in_virtual_time()
async def test_the_timer_is_set_anew_if_something_is_due_earlier() -> None:
    arm = Arm()
    rules = Schedule(concurrency=1, queue=1, queue_timeout=10, run_timeout=100)
    async with serving(rules, arm) as site:
        running = await site.send(1)
        await anyio.sleep(1)
        waiting = await site.send(2)
        begun_at = anyio.current_time()
        assert (await waiting.outcome()).reason == "waited for 10 s"
        assert anyio.current_time() - begun_at == pytest.approx(10)
        assert (await running.outcome()).reason == "took longer than 100 s"
        assert anyio.current_time() - begun_at == pytest.approx(99)


@in_virtual_time()
@pytest.mark.parametrize("skips", [True, False])
async def test_a_goal_whose_client_has_given_it_up_meanwhile_is_skipped_if_so_told(
    skips: bool,
) -> None:
    arm = Arm()
    async with serving(Schedule(concurrency=1, queue=9, skip_expired=skips), arm) as site:
        await site.send(1, timeout=1)  # it has its turn at once
        given_up = await site.send(2, timeout=2)
        await site.send(3, timeout=4)
        await anyio.sleep(3)
        assert given_up.status is GoalStatus.ACCEPTED
        arm.let_end(1)
        if skips:
            reason = "its client's timeout was over before its turn came"
            assert await given_up.outcome() == End(GoalStatus.ABORTED, None, reason)
        else:
            await arm.until_begun(2)
            arm.let_end(2)
        await arm.until_begun(3)
    assert arm.begun == ([1, 3] if skips else [1, 2, 3])


# Functions that fail


def raises(goal: Goal) -> int:
    if goal.order:
        raise ValueError("no such joint")
    return 0


def answers_later(goal: Goal) -> Any:
    async def later() -> int:
        return 0

    return later() if goal.order else 0


def answers(answer: object) -> Callable[[Goal], Any]:
    return lambda goal: answer if goal.order else 0


class Later:
    """A value that is hashable, and has to be awaited, as a future is."""

    def __await__(self) -> Generator[None, None, int]:
        yield
        return 1


@pytest.mark.parametrize(
    ("name", "function", "reason"),
    [
        ("key", raises, "key failed: ValueError: no such joint"),
        ("key", answers([]), "key failed: TypeError: unhashable type: 'list'"),
        (
            "key",
            answers(Later()),
            "key failed: TypeError: it returned something to await, and not a value",
        ),
        (
            "key",
            answers(math.nan),
            "key failed: ValueError: it returned nan, which is not equal to itself",
        ),
        (
            "priority",
            answers_later,
            "priority failed: TypeError: it returned something to await, and not a value",
        ),
        ("priority", raises, "priority failed: ValueError: no such joint"),
        (
            "priority",
            answers("9"),
            "priority failed: TypeError: it returned '9', which is not a number",
        ),
        (
            "priority",
            answers(math.nan),
            "priority failed: ValueError: it returned nan, which is not before or after any number",
        ),
    ],
)
async def test_a_goal_is_rejected_by_the_function_that_fails_and_the_server_goes_on(
    name: str, function: Any, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    arm = Arm()
    rules: dict[str, Any] = {name: function}
    async with serving(Schedule(concurrency=1, **rules), arm) as site:
        for _ in range(2):
            with pytest.raises(GoalRejected) as caught:
                await site.send(1)
            assert caught.value.reason == reason
        await site.send(0)
        await arm.until_begun(0)
    lines = [line for line in caplog.records if line.levelname == "ERROR"]
    assert [line.getMessage() for line in lines] == [f"action 'fibonacci': {reason}"]
    assert lines[0].exc_info is not None


# Preempting


async def test_a_goal_that_ends_as_canceled_by_itself_is_aborted_with_the_servers_reason() -> None:
    async def gives_up(goal: GoalHandle[Goal]) -> Items:
        if goal.request.order == 1:
            while not goal.cancel_requested:
                with suppress(anyio.get_cancelled_exc_class()):
                    await anyio.sleep_forever()
            raise GoalCanceled("a word of its own")
        yield Result([])

    async with serving(PREEMPTING, gives_up) as site:
        first = await site.send(1)
        await settled()
        await site.send(2)
        assert await first.outcome() == End(GoalStatus.ABORTED, None, site.preempted_by(2))


# Killing


class Refusing:
    """An executor that catches every cancellation, and goes on."""

    def __init__(self) -> None:
        self.begun: list[int] = []
        self.go = anyio.Event()

    async def __call__(self, goal: GoalHandle[Goal]) -> AsyncIterator[Feedback | Result]:
        self.begun.append(goal.request.order)
        while not self.go.is_set():
            try:
                await self.go.wait()
                yield Feedback([])
            except BaseException:  # the mistake that is tested
                continue
        yield Result([])


async def until_logged(caplog: pytest.LogCaptureFixture, text: str) -> None:
    """Wait for a line in the log."""
    while text not in caplog.text:
        await checkpoint()


async def test_a_killed_executor_that_survives_keeps_its_place_until_it_has_ended(
    caplog: pytest.LogCaptureFixture,
) -> None:
    executor = Refusing()
    rules = Schedule(concurrency=1, when_full="preempt")
    async with serving(rules, executor, shutdown_timeout=0, result_timeout=0) as site:
        first = await site.send(1)
        await settled()
        second = await site.send(2)
        assert await first.outcome() == End(GoalStatus.ABORTED, None, site.preempted_by(2))
        await until_logged(caplog, "runs on")
        await settled()
        assert (executor.begun, second.status) == ([1], GoalStatus.ACCEPTED)
        with pytest.raises(GoalRejected) as caught:
            await site.send(1)  # it is forgotten, but its executor still has its place
        name = site.id_of(1)
        assert caught.value.reason == (
            f"busy: an earlier goal {name} was killed, and has not ended yet"
        )
        executor.go.set()
        assert (await second.outcome()).status is GoalStatus.SUCCEEDED
        assert (await (await site.send(1)).outcome()).status is GoalStatus.SUCCEEDED
    (line,) = [line for line in caplog.records if line.levelname == "ERROR"]
    assert line.getMessage() == (
        f"goal {name} of action 'fibonacci' does not end though it was killed, and"
        f" runs on; its place in the schedule stays taken until then"
    )
    assert executor.begun == [1, 2, 1]


async def test_a_killed_executor_that_survives_is_given_up_when_the_server_stops(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("fibaction.server.execution.task_pool.GRACE", 0.01)
    executor = Refusing()
    async with serving(PREEMPTING, executor, shutdown_timeout=0) as site:
        await site.send(1)
        await settled()
        await site.send(2)
        await until_logged(caplog, "runs on")
        assert "is abandoned" not in caplog.text
    assert "is abandoned" in caplog.text
    assert executor.begun == [1]


# Taking over


async def test_a_goal_takes_nothing_over_after_its_result() -> None:
    caught: list[str] = []
    told, done = anyio.Event(), anyio.Event()

    async def is_late(goal: GoalHandle[Goal]) -> Items:
        if goal.request.order == 1:
            yield Result([1])
            told.set()
            await goal.wait_for_successor()
            with pytest.raises(RuntimeError) as error:
                goal.take_over()
            caught.append(str(error.value))
            done.set()
        else:
            yield Result([2])

    async with serving(HANDING_OVER, is_late) as site:
        first = await site.send(1)
        await told.wait()
        second = await site.send(2)
        await done.wait()
        assert await first.outcome() == End(GoalStatus.SUCCEEDED, result(1))
        assert await second.outcome() == End(GoalStatus.SUCCEEDED, result(2))
    assert caught == ["take over a goal before the result of this one, not after it"]


class Grasping(Arm):
    """An executor that tries to take its successor over when it is interrupted."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[object] = []

    async def __call__(self, goal: GoalHandle[Goal]) -> Items:
        self.begin(goal)
        try:
            await self.end_of(goal.request.order)
        finally:
            self.seen.append(goal.successor)
            with pytest.raises(RuntimeError, match="has no successor that it may take over"):
                goal.take_over()
        yield Result([goal.request.order])


@in_virtual_time()
async def test_an_executor_that_was_interrupted_for_its_successor_cannot_take_it_over() -> None:
    arm = Grasping()
    async with serving(Schedule(concurrency=1, when_full="preempt", handover=3), arm) as site:
        first = await site.send(1)
        handle = await arm.until_begun(1)
        second = await site.send(2)
        sent_at = anyio.current_time()
        assert await handle.wait_for_successor() is handle.successor
        assert (await first.outcome()).reason == site.preempted_by(2)
        assert anyio.current_time() - sent_at == pytest.approx(3)
        await arm.until_begun(2)
        arm.let_end(2)
        assert (await second.outcome()).status is GoalStatus.SUCCEEDED
    assert arm.seen == [None, None]


async def test_an_executor_that_was_interrupted_by_a_cancel_cannot_take_over() -> None:
    # The interruption would end the successor, or a later cancel of it would interrupt nothing.
    arm = Grasping()
    async with serving(HANDING_OVER, arm) as site:
        first = await site.send(1)
        await arm.until_begun(1)
        second = await site.send(2)
        await site.cancel(1)
        assert (await first.outcome()).status is GoalStatus.CANCELED
        await arm.until_begun(2)
        await site.cancel(2)
        assert (await second.outcome()).status is GoalStatus.CANCELED
    assert arm.seen == [None, None]


async def test_whoever_waits_for_a_successor_is_told_of_it_or_of_the_end() -> None:
    arm = Arm()
    async with serving(HANDING_OVER, arm) as site:
        first = await site.send(1)
        handle = await arm.until_begun(1)
        seen: list[GoalID] = []

        async def wait() -> None:
            seen.append((await handle.wait_for_successor()).goal_id)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(wait)
            tasks.start_soon(wait)
            await settled()
            assert seen == []
            await site.send(2)
        assert seen == [site.id_of(2)] * 2
        await site.cancel(2)

        async def wait_in_vain() -> None:
            with pytest.raises(RuntimeError, match=f"^goal {handle.goal_id} has ended, and gets"):
                await handle.wait_for_successor()

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(wait_in_vain)
            await settled()
            arm.let_end(1)
        assert (await first.outcome()).status is GoalStatus.SUCCEEDED


async def test_without_a_schedule_a_goal_never_has_a_successor() -> None:
    arm = Arm()
    async with ActionServer(FIBONACCI, arm) as server:
        with anyio.fail_after(5):
            await server.send_goal(GoalID.random(), packed(1))
            handle = await arm.until_begun(1)
            assert handle.successor is None
            with pytest.raises(RuntimeError, match="the server has no schedule"):
                handle.take_over()
            with anyio.CancelScope() as scope:
                async with anyio.create_task_group() as tasks:
                    tasks.start_soon(handle.wait_for_successor)
                    await settled()
                    scope.cancel()
            assert scope.cancelled_caught


async def test_without_a_schedule_a_goal_begins_when_it_is_accepted_unless_the_server_stops() -> (
    None
):
    begun: list[GoalID] = []
    goals: Any = SimpleNamespace(begin=begun.append)
    tasks: Any = None  # it needs none
    dispatcher: Dispatcher[int] = Dispatcher()
    await dispatcher.open(tasks, goals, lambda: None, Keeper("work").key_slots)
    one, other = GoalID.random(), GoalID.random()
    dispatcher.accepted(one)
    dispatcher.close()
    dispatcher.accepted(other)
    assert begun == [one]

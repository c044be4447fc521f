"""Goals that other servers take over, and that come from them, with a store in memory."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import Any, NamedTuple

import anyio
import pytest
from anyio import current_time

from fibaction import (
    CancelCode,
    ConnectionLost,
    GoalAborted,
    GoalCanceled,
    GoalHandle,
    GoalID,
    GoalKept,
    GoalRejected,
    GoalStatus,
    Schedule,
    StoreError,
    UnknownGoal,
)
from fibaction.border.goal_store import GoalTaken, StoredGoal
from fibaction.server.life import Phase
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.server.scheduling.goal_dispatcher import GoalDispatcher
from fibaction.words.goals import UNKNOWN_SENDER
from tests.server.held import fails
from tests.server.painting import (
    ID,
    PAINT,
    Painting,
    Server,
    client_of,
    server_with,
    stored,
)
from tests.support.memory_store import Fate, MemoryStore
from tests.support.virtual_time import in_virtual_time

pytestmark = [pytest.mark.anyio, in_virtual_time()]

TAKEN = "another server has taken the goal over"


def taking(what: str) -> MemoryStore:
    """Return a store in which the goal of the first such write belongs to another server."""
    fates = {what: Fate.TAKEN}
    return MemoryStore(lambda _number, write: fates.pop(write, Fate.KEPT))


class CleanUp:
    """An executor that waits, and whose clean-up takes its time."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self.begun: list[tuple[int, float]] = []
        self.ended: list[float] = []

    async def __call__(self, goal: GoalHandle[int]) -> Painting:
        self.begun.append((goal.attempt, current_time()))
        try:
            await anyio.sleep(goal.request)
        finally:
            await anyio.sleep(self._seconds)
            self.ended.append(current_time())
        yield f"attempt {goal.attempt}"


# Lost


@pytest.mark.parametrize("schedule", [None, Schedule(concurrency=1)])
async def test_a_loss_that_overtakes_answers_is_told_to_clients_and_nothing_else_happens(
    schedule: Any,
) -> None:
    store = MemoryStore()

    def take(_what: str, goal: StoredGoal) -> None:
        store.take("paint", GoalID(goal.goal_id))

    async with server_with(store, schedule=schedule) as server:
        store.on_kept = take
        with pytest.raises(ConnectionLost, match=TAKEN):
            await client_of(server).send_goal(1)
        store.on_kept = lambda _what, _goal: None
        assert await client_of(server).call(1) == "painted 1 in attempt 1"


async def test_a_loss_that_is_told_while_the_end_is_written_is_told_in_place_of_the_end() -> None:
    store = MemoryStore()
    async with server_with(store) as server:
        goal = await client_of(server).send_goal(1)
        await anyio.sleep(0.5)
        store.hold()
        await anyio.sleep(1)
        assert store.take("paint", goal.goal_id) is not None
        store.release()
        with pytest.raises(ConnectionLost, match=TAKEN):
            await goal.result()
        await anyio.sleep(1)
        assert await client_of(server).goals() == []
        assert await client_of(server).call(1) == "painted 1 in attempt 1"


async def test_a_goal_that_is_unknown_or_has_ended_is_not_lost() -> None:
    store = MemoryStore()
    async with server_with(store) as server:
        goal = await client_of(server).send_goal(1)
        assert await goal.result() == "painted 1 in attempt 1"
        store.take("paint", goal.goal_id)
        store.take("paint", GoalID.random())
        again = await client_of(server).attach(goal.goal_id)
        assert await again.result() == "painted 1 in attempt 1"


async def test_the_loss_of_a_goal_whose_executor_was_taken_over_leaves_the_successor() -> None:
    async def hand_over(goal: GoalHandle[int]) -> Painting:
        if goal.request:
            await goal.wait_for_successor()
            goal = goal.take_over()
        await anyio.sleep(1)
        yield f"painted {goal.request}"

    store = taking("end")
    schedule = Schedule(concurrency=1, when_full="preempt", handover=9)
    async with server_with(store, hand_over, schedule=schedule) as server:
        first, second = [await client_of(server).send_goal(order) for order in (1, 0)]
        with pytest.raises(ConnectionLost, match=TAKEN):
            await first.result()
        assert await second.result() == "painted 0"


@pytest.mark.parametrize("when_full", ["preempt", "replace"])
async def test_orders_for_other_goals_are_carried_out_if_a_goal_is_not_accepted(
    when_full: Any,
) -> None:
    accepted = 0

    def fate(_number: int, what: str) -> Fate:
        nonlocal accepted
        accepted += what == "accept"
        return Fate.TAKEN if (what, accepted) == ("accept", 3) else Fate.KEPT

    store = MemoryStore(fate)
    queue = 1 if when_full == "replace" else 0
    schedule = Schedule(concurrency=2 - queue, queue=queue, when_full=when_full)
    async with server_with(store, schedule=schedule) as server:
        client = client_of(server)
        first, second = [await client.send_goal(1000) for _ in range(2)]
        with pytest.raises(ConnectionLost, match=TAKEN):
            await client.send_goal(1000)
        gives_way = first if when_full == "preempt" else second
        with pytest.raises(GoalAborted, match=r"preempted by|replaced by"), anyio.fail_after(5):
            await gives_way.result()
        assert await (await client.send_goal(0)).result() == "painted 0 in attempt 1"


async def test_a_lost_goal_is_unknown_to_all_who_follow() -> None:
    store = MemoryStore()
    async with server_with(store) as server:
        goal = await client_of(server).send_goal(1000)
        await anyio.sleep(1.5)
        with await server.status() as statuses:
            assert (await statuses.receive()) is not None
            store.take("paint", goal.goal_id)
            gone = await statuses.receive()
            assert gone is not None
            assert (gone.goal_id, gone.status) == (goal.goal_id, GoalStatus.UNKNOWN)
        feedback = aiter(goal.feedback)
        with pytest.raises(ConnectionLost, match=TAKEN):
            while True:
                await anext(feedback)
        with pytest.raises(UnknownGoal):
            await client_of(server).attach(goal.goal_id)
        assert await client_of(server).goals() == []


async def test_a_checkpoint_of_a_goal_that_was_taken_is_an_error_of_the_executor() -> None:
    errors: list[StoreError] = []

    async def persist(goal: GoalHandle[int]) -> Painting:
        try:
            with anyio.CancelScope(shield=True):
                await goal.checkpoint(1)
        except StoreError as exc:
            errors.append(exc)
            assert goal.cancel_requested
            raise
        yield ""

    async with server_with(taking("checkpoint"), persist) as server:
        with pytest.raises(ConnectionLost, match=TAKEN):
            await client_of(server).call(1)
        await anyio.sleep(1)
        assert [type(error) for error in errors] == [GoalTaken]


async def test_a_goal_that_is_taken_while_its_cancel_is_written_is_not_in_the_answer() -> None:
    for only_one in (True, False):
        async with server_with(taking("cancel")) as server:
            goal, other = [await client_of(server).send_goal(1000) for _ in range(2)]
            if only_one:
                answer = await goal.cancel()
                assert (answer.return_code, answer.goals_canceling) == (
                    CancelCode.UNKNOWN_GOAL_ID,
                    (),
                )
                continue
            answer = await client_of(server).cancel_goals()
            assert answer.return_code is CancelCode.NONE
            assert [info.goal_id for info in answer.goals_canceling] == [other.goal_id]
            with pytest.raises(GoalCanceled):
                await other.result()


@asynccontextmanager
async def running(clean_up: float) -> AsyncGenerator[Running, None]:
    """Run a goal that another server can take, and whose clean-up takes so many seconds."""
    store, executor = MemoryStore(), CleanUp(clean_up)
    async with server_with(store, executor, shutdown_timeout=5) as server:
        goal = await client_of(server).send_goal(1000)
        await anyio.sleep(1)
        yield Running(server, executor, lambda: store.take("paint", goal.goal_id))


class Running(NamedTuple):
    """A server with a goal that runs."""

    server: Server
    executor: CleanUp
    take: Callable[[], object]


async def test_the_executor_of_a_lost_goal_is_killed_if_its_clean_up_takes_too_long() -> None:
    async with running(50) as one:
        begin = current_time()
        one.take()
        await anyio.sleep(1)
        assert len(one.server._parts.runs.lost.executions) == 1
        await anyio.sleep(5)
        assert len(one.server._parts.runs.lost.executions) == 0
        assert one.executor.ended == []  # its clean-up was cut off
        assert current_time() - begin < 7


@pytest.mark.parametrize(("clean_up", "ended"), [(3, 1), (30, 0)])
async def test_a_stop_waits_for_the_executors_of_lost_goals_and_kills_them(
    clean_up: float, ended: int
) -> None:
    async with running(clean_up) as one:
        one.take()
        await anyio.sleep(1)
        begin = current_time()
        await one.server.stop()
        assert current_time() - begin < 7
    assert len(one.executor.ended) == ended


async def test_a_stop_kills_the_executor_of_a_goal_that_is_lost_while_the_server_stops() -> None:
    async with running(30) as one:
        begin = current_time()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(one.server.stop)
            await anyio.sleep(1)
            one.take()
        assert current_time() - begin < 5.5
    assert one.executor.ended == []


# Taken over


async def test_a_goal_that_comes_later_is_known_followed_and_run() -> None:
    store = MemoryStore()
    async with server_with(store, recovery="rerun") as server:
        with await server.status() as statuses:
            store.give("paint", stored(is_running=True, attempt=1, worker="w"))
            for status in (GoalStatus.EXECUTING, GoalStatus.SUCCEEDED):
                info = await statuses.receive()
                assert info is not None
                assert (info.goal_id, info.status) == (ID, status)
                if status.is_active:
                    goal = await client_of(server).attach(ID)
        assert await goal.result() == "painted 3 in attempt 2"
        assert store.goals["paint", ID].status is GoalStatus.SUCCEEDED


async def test_an_outcome_that_comes_later_is_known_and_told() -> None:
    store = MemoryStore()
    async with server_with(store) as server:
        with await server.status() as statuses:
            ended = stored(status=GoalStatus.SUCCEEDED, attempt=1, ended_at=1)
            ended.result = PAINT.result.encode("painted")
            for _ in range(2):
                store.give("paint", ended)
                info = await statuses.receive()
                assert info is not None
                assert (info.goal_id, info.status) == (ID, GoalStatus.SUCCEEDED)
        assert await (await client_of(server).attach(ID)).result() == "painted"
        await anyio.sleep(100)
        assert await client_of(server).goals() == []
        assert server._parts.runs._registry.results.size == 0


@pytest.mark.parametrize(
    ("settings", "goal", "reason"),
    [
        ({}, stored(is_running=True, attempt=1, worker="w"), "the worker 'w' was lost"),
        (
            {"recovery": "rerun", "max_attempts": 2},
            stored(is_running=True, attempt=2, lost=1, worker="w"),
            "given up after 2 attempts: the worker 'w' was lost",
        ),
        ({}, stored(status=GoalStatus.CANCELING, worker="w"), "the worker 'w' was lost"),
    ],
    ids=["aborted", "given up", "canceled"],
)
async def test_a_goal_that_a_lost_worker_has_left_ends_with_that_reason(
    settings: Any, goal: StoredGoal, reason: str
) -> None:
    store = MemoryStore()
    async with server_with(store, **settings) as server:
        store.give("paint", goal)
        await anyio.sleep(0.1)
        outcome = await (await client_of(server).attach(ID)).outcome()
        assert outcome.reason == reason


@pytest.mark.parametrize("schedule", [None, Schedule(concurrency=1, queue=1)])
async def test_a_goal_that_comes_back_waits_for_its_old_executor(schedule: Any) -> None:
    store, executor = MemoryStore(), CleanUp(3)
    settings: dict[str, Any] = {"recovery": "rerun", "schedule": schedule}
    async with server_with(store, executor, **settings) as server:
        await server.send_goal(ID, PAINT.goal.encode(5))
        await anyio.sleep(1)
        for _ in range(2):  # it comes and goes, and is there in the end
            goal = store.take("paint", ID)
            assert goal is not None
            store.give("paint", goal)
            await anyio.sleep(0.5)
        assert [attempt for attempt, _ in executor.begun] == [1]
        back = await client_of(server).attach(ID)
        assert back.status is GoalStatus.EXECUTING
        assert await back.result() == "attempt 2"
        assert [attempt for attempt, _ in executor.begun] == [1, 2]
        assert executor.begun[1][1] >= executor.ended[0]
        if isinstance(server._dispatcher, GoalDispatcher):
            assert server._dispatcher._shared.scheduler._entries == {}


async def test_a_goal_that_is_lost_before_it_is_taken_over_stays_with_the_other_server() -> None:
    store = MemoryStore()
    async with server_with(store, recovery="rerun") as server:
        store.give("paint", stored())
        store.give("paint", stored(number=2))
        store.take("paint", ID)
        await anyio.sleep(0.1)
        with pytest.raises(UnknownGoal):
            await client_of(server).attach(ID)
        assert len(await client_of(server).goals()) == 1


async def test_a_goal_that_is_handed_over_twice_runs_once() -> None:
    store, executor = MemoryStore(), CleanUp(0)
    async with server_with(store, executor) as server:
        for _ in range(2):
            store.give("paint", stored(1))
        await anyio.sleep(0.5)
        assert await (await client_of(server).attach(ID)).result() == "attempt 1"
    assert len(executor.begun) == 1


@pytest.mark.parametrize("schedule", [None, Schedule(concurrency=1, queue=1)])
async def test_a_goal_that_comes_while_it_is_sent_here_is_that_goal_for_its_sender(
    schedule: Any,
) -> None:
    store = MemoryStore()
    async with server_with(store, schedule=schedule) as server, anyio.create_task_group() as tasks:
        results: list[str] = []

        async def send() -> None:
            stream = await server.send_goal(ID, PAINT.goal.encode(1))
            results.append(PAINT.result.decode((await stream.outcome()).result or b""))

        store.hold()
        tasks.start_soon(send)
        await anyio.sleep(1)
        store.note_takeover("paint", ID)
        store.give("paint", stored(1))
        await anyio.sleep(1)
        store.release()
        await anyio.sleep(3)
        assert results == ["painted 1 in attempt 1"]


async def test_a_goal_that_waits_for_a_decision_here_is_taken_over_after_it() -> None:
    async def reject(_goal: int) -> None:
        await anyio.sleep(5)
        raise GoalRejected("not here")

    store = MemoryStore()
    async with server_with(store, on_goal=reject) as server, anyio.create_task_group() as tasks:
        request = PAINT.goal.encode(1)
        tasks.start_soon(fails, GoalRejected, "not here", server.send_goal, ID, request)
        await anyio.sleep(1)
        store.give("paint", stored(1))
        await anyio.sleep(6)
        outcome = await server.get_result(ID)
        assert PAINT.result.decode(outcome.result or b"") == "painted 1 in attempt 1"


async def test_a_goal_that_waits_for_a_decision_here_is_left_alone_if_the_store_fails() -> None:
    async def decide(goal: int) -> None:
        if goal == 1:
            await anyio.sleep(5)

    store = MemoryStore(lambda _number, what: Fate.FAILED if what == "end" else Fate.KEPT)
    server = server_with(store, on_goal=decide)
    with pytest.raises(StoreError):
        async with server:
            await server.send_goal(GoalID.random(), PAINT.goal.encode(2))

            async with anyio.create_task_group() as tasks:
                tasks.start_soon(
                    fails, GoalKept, "failed", server.send_goal, ID, PAINT.goal.encode(1)
                )
                await anyio.sleep(1)
                store.give("paint", stored(1))
                await anyio.sleep_forever()
    assert store.goals["paint", ID].attempt == 0


# Leases


async def test_an_executor_takes_no_step_when_the_lease_is_over() -> None:
    store, steps = MemoryStore(), list[float]()
    lease = current_time() + 10

    async def step(goal: GoalHandle[int]) -> Painting:
        try:
            while True:
                await anyio.sleep(3)
                steps.append(current_time())
        finally:
            steps.append(-1)
        yield ""

    store.valid_until = lambda: lease
    async with server_with(store, step) as server:
        goal = await client_of(server).send_goal(1)
        with pytest.raises(ConnectionLost, match="cut off from its store"):
            await goal.result()
        assert (len(steps), steps[-1]) == (4, -1)
        assert max(steps) < lease
        assert store.goals["paint", goal.goal_id].is_running is False
        assert await client_of(server).goals() == []


async def test_a_goal_whose_turn_comes_when_the_lease_is_over_never_runs() -> None:
    store, executor = MemoryStore(), CleanUp(0)
    store.valid_until = current_time
    async with server_with(store, executor) as server:
        with pytest.raises(ConnectionLost):
            await client_of(server).call(1)
    assert executor.begun == []


@pytest.mark.parametrize("is_canceled", [False, True])
async def test_a_shield_is_left_in_peace_until_it_ends(is_canceled: bool) -> None:
    store, lease, done = MemoryStore(), current_time() + 1, anyio.Event()
    begun = anyio.Event()

    async def finish(goal: GoalHandle[int]) -> Painting:
        with anyio.CancelScope(shield=True):
            begun.set()
            await done.wait()
        yield "done"

    store.valid_until = lambda: lease
    async with server_with(store, finish) as server:
        goal = await client_of(server).send_goal(1)
        await begun.wait()
        if is_canceled:
            await goal.cancel()
        await anyio.sleep(3)
        done.set()
        assert await goal.result() == "done"


async def test_an_executor_that_does_not_end_when_the_lease_is_over_is_killed() -> None:
    store, executor = MemoryStore(), CleanUp(50)
    lease = current_time() + 1
    store.valid_until = lambda: lease
    async with server_with(store, executor, shutdown_timeout=2) as server:
        begin = current_time()
        with pytest.raises(ConnectionLost):
            await client_of(server).call(5)
        assert current_time() - begin < 8
    assert executor.ended == []


async def test_the_loss_of_a_goal_that_has_ended_here_is_only_noted() -> None:
    async with server_with(MemoryStore()) as server:
        record = GoalRecord(ID, b"", 1, UNKNOWN_SENDER)
        record.phase = Phase.ENDED
        server._parts.runs.lose(record)
        assert record.phase is Phase.LOST


async def test_an_executor_whose_loss_was_not_noted_is_none_of_the_lost_ones() -> None:
    async with server_with(MemoryStore()) as server:
        execution: Any = SimpleNamespace(goal=SimpleNamespace(goal_id=ID))
        assert not server._parts.runs.lost.discard(execution)

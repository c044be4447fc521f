"""The server and its store: what is not seen through a connection, with a store in memory."""

from __future__ import annotations

import time
from typing import Any

import anyio
import pytest
from anyio import current_time

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    CancelCode,
    ClientGoal,
    ConnectionLost,
    GoalAborted,
    GoalHandle,
    GoalID,
    GoalKept,
    GoalRejected,
    GoalStatus,
    Parent,
    Schedule,
    ServerNotFound,
    StoreError,
)
from fibaction.border.abc import FeedbackItem
from fibaction.border.goal_store import StoredGoal
from fibaction.server.durability.goal_keeper import SECOND
from fibaction.server.durability.recovery import ASKED_AT_ONCE
from tests.server.held import fails, id_of
from tests.server.painting import (
    ID,
    PAINT,
    Painting,
    Server,
    client_of,
    paint,
    server_with,
    store_with,
    stored,
)
from tests.support.memory_store import Fate, MemoryStore
from tests.support.slices import let_slices_last
from tests.support.virtual_time import in_virtual_time

pytestmark = [pytest.mark.anyio, in_virtual_time()]


async def attached(server: Server, number: int = 1) -> ClientGoal[int, str]:
    return await client_of(server).attach(id_of(number))


# A store that is missing


async def test_a_store_is_given_once_and_before_the_start() -> None:
    server = server_with(MemoryStore())
    with pytest.raises(RuntimeError, match="has a store"):
        server.keep_in(MemoryStore())
    async with ActionServer(PAINT, paint) as other:
        with pytest.raises(RuntimeError, match="was started before"):
            other.keep_in(MemoryStore())


async def test_goals_cannot_be_kept_at_a_stop_without_a_store() -> None:
    server = ActionServer(PAINT, paint, at_stop="keep")
    with pytest.raises(ValueError, match="needs a store"):
        await server.__aenter__()


ADVICE = "give the server a store, such as store=SqliteStore('goals.db')"


def warnings_in(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]


def decide(goal: GoalHandle[int]) -> None:
    """Run each goal again."""


@pytest.mark.parametrize("recovery", ["rerun", decide])
async def test_a_recovery_without_a_store_is_warned_of_at_the_start(
    recovery: Any, caplog: pytest.LogCaptureFixture
) -> None:
    async with ActionServer(PAINT, paint, recovery=recovery):
        assert warnings_in(caplog) == [
            f"action server 'paint' has no store, so its `recovery` has no effect: {ADVICE}"
        ]


async def test_the_first_checkpoint_without_a_store_is_warned_of(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with ActionServer(PAINT, paint) as server:
        assert caplog.records == []
        for _ in range(2):
            await client_of(server).call(2)
    assert warnings_in(caplog) == [
        f"action server 'paint' has no store, so goal.checkpoint() keeps nothing: {ADVICE}"
    ]


# Acceptance


async def test_a_goal_whose_sender_does_not_wait_is_accepted_all_the_same() -> None:
    store = MemoryStore()
    async with server_with(store) as server:
        store.hold()
        with anyio.move_on_after(1):
            await server.send_goal(ID, PAINT.goal.encode(2))
        store.release()
        again = await server.send_goal(ID, PAINT.goal.encode(2))
        assert (await again.outcome()).result == PAINT.result.encode("painted 2 in attempt 1")
        assert store.writes == 4


async def test_the_meta_of_a_goal_is_kept_until_its_end() -> None:
    store = MemoryStore()
    meta = {"traceparent": "00-1"}
    async with server_with(store) as server:
        stream = await server.send_goal(ID, PAINT.goal.encode(1), meta=meta)
        kept = store.goals["paint", ID].meta
        await stream.outcome()

    assert kept == meta
    assert store.goals["paint", ID].meta is None


async def test_the_parent_of_a_goal_is_kept_after_its_end() -> None:
    store = MemoryStore()
    meta = {"parent": str(ID), "step": "first coat", "traceparent": "00-1"}
    child = GoalID.random()
    async with server_with(store) as server:
        stream = await server.send_goal(child, PAINT.goal.encode(1), meta=meta)
        await stream.outcome()

    assert store.goals["paint", child].meta == {"parent": str(ID), "step": "first coat"}
    async with server_with(store) as server:
        (info,) = await client_of(server).goals()
        assert info.parent == Parent(ID, "first coat")


async def test_a_deadline_goes_on_after_a_restart() -> None:
    deadlines: list[float] = []

    async def note(goal: GoalHandle[int]) -> Painting:
        deadlines.append(goal.deadline - current_time())
        await anyio.sleep_forever()
        yield ""

    store = MemoryStore()
    for _ in range(2):
        async with ActionServer(PAINT, note, store=store, at_stop="keep") as server:
            await server.send_goal(ID, PAINT.goal.encode(2), timeout=500)
            await anyio.sleep(1)
    assert deadlines == [pytest.approx(500, abs=1), pytest.approx(500, abs=60)]


ASKED = 10


@pytest.mark.promise("KEEP-6")
async def test_a_cancel_of_a_goal_that_a_stopping_server_keeps_does_not_come_too_late() -> None:
    store, is_released = MemoryStore(), anyio.Event()

    def note() -> float:
        if store.is_holding:
            is_released.set()
        return 0

    store.delay = note
    errors: list[Exception] = []

    async def cancel(server: Server) -> None:
        await is_released.wait()
        async with anyio.create_task_group() as tasks:
            for _ in range(ASKED):  # in any order with what ends the server
                tasks.start_soon(ask, server)
            await anyio.wait_all_tasks_blocked()
            assert errors == []
            store.release()

    async def ask(server: Server) -> None:
        with pytest.raises(GoalKept) as caught:
            await server.cancel_goals(ID)
        errors.append(caught.value)

    async with anyio.create_task_group() as tasks:
        async with ActionServer(PAINT, wait, store=store, at_stop="keep") as server:
            await server.send_goal(ID, PAINT.goal.encode(1000))
            await anyio.sleep(1)
            store.hold()
            tasks.start_soon(cancel, server)
    assert len(errors) == ASKED


# Goals that belong to another server by now


async def test_a_waiting_goal_that_another_server_has_taken_over_leaves_its_place() -> None:
    store = MemoryStore()
    async with server_with(store, schedule=Schedule(concurrency=1, queue=1)) as server:
        first, second = [await client_of(server).send_goal(order) for order in (9, 1)]
        store.take("paint", second.goal_id)
        store.take("paint", second.goal_id)  # told twice
        with pytest.raises(ConnectionLost):
            await second.result()
        third = await client_of(server).send_goal(1)
        await first.cancel()
        assert await third.result() == "painted 1 in attempt 1"


# Schedules


async def wait(goal: GoalHandle[int]) -> Painting:
    """Wait so many seconds, and take over each successor."""
    with anyio.move_on_after(goal.request):
        while True:
            await goal.wait_for_successor()
            goal = goal.take_over()
            yield goal.request
    yield "waited"


async def test_a_goal_whose_turn_comes_while_its_acceptance_is_written_begins_afterwards() -> None:
    store = MemoryStore()
    schedule = Schedule(concurrency=1, queue=2)
    async with ActionServer(PAINT, wait, store=store, schedule=schedule) as server:
        client = client_of(server)
        first = await client.send_goal(1)
        results: list[str] = []

        async def call() -> None:
            results.append(await client.call(2))

        async with anyio.create_task_group() as tasks:
            store.hold()
            tasks.start_soon(call)
            await anyio.sleep(0.5)
            assert len(await client.goals()) == 1  # a goal that has a place and is not accepted yet
            await anyio.sleep(5)  # the first goal ends, and its end waits as well
            store.release()
        assert await first.result() == "waited"
        assert results == ["waited"]


async def test_a_goal_that_is_canceled_while_its_begin_is_written_never_runs() -> None:
    store = MemoryStore()
    async with server_with(store, schedule=Schedule(concurrency=1, queue=2)) as server:
        client = client_of(server)
        first, second = [await client.send_goal(order) for order in (1, 5)]
        store.on_kept = lambda what, _goal: store.hold() if what == "end" else None
        await first.outcome()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(second.cancel)
            await anyio.sleep(1)
            store.on_kept = lambda _what, _goal: None
            store.release()
        assert (await second.outcome()).status is GoalStatus.CANCELED
        assert [feedback async for feedback in second.feedback] == []
        assert await client.call(1) == "painted 1 in attempt 1"


async def test_a_goal_that_is_killed_while_its_begin_is_written_gives_its_place_back() -> None:
    store = MemoryStore()
    schedule = Schedule(concurrency=1, queue=2, run_timeout=3)
    async with server_with(store, schedule=schedule, shutdown_timeout=1) as server:
        client = client_of(server)
        first, second = [await client.send_goal(order) for order in (1, 2)]
        store.on_kept = lambda what, _goal: store.hold() if what == "end" else None
        await first.outcome()
        await anyio.sleep(10)
        store.on_kept = lambda _what, _goal: None
        store.release()
        assert (await second.outcome()).reason == "took longer than 3 s"
        server._parts.runs.begin(second.goal_id)  # an order that comes too late
        assert await client.call(1) == "painted 1 in attempt 1"


async def test_a_goal_whose_kill_is_due_before_its_interruption_is_interrupted_first() -> None:
    schedule = Schedule(concurrency=1, when_full="preempt", run_timeout=3)
    store = MemoryStore()
    settings: dict[str, Any] = {"schedule": schedule, "shutdown_timeout": 1}
    async with server_with(store, **settings) as server, anyio.create_task_group() as tasks:
        goal = await client_of(server).send_goal(100)
        store.hold()
        newer = GoalID.random()
        request = PAINT.goal.encode(1)
        tasks.start_soon(server.send_goal, newer, request)
        await anyio.sleep(5)
        assert goal.status is GoalStatus.EXECUTING
        store.release()
        with pytest.raises(GoalAborted, match=f"preempted by {newer}"):
            await goal.result()


@pytest.mark.parametrize("canceled", [False, True])
async def test_a_goal_that_was_taken_over_is_told_to_run_when_its_begin_is_kept(
    canceled: bool,
) -> None:
    # A server that fails before has the goal as ACCEPTED after its next start.
    store = MemoryStore()
    schedule = Schedule(concurrency=1, when_full="preempt", handover=5)
    server = ActionServer(PAINT, wait, store=store, schedule=schedule, interrupt_on_cancel=False)
    async with server, anyio.create_task_group() as tasks:
        client = client_of(server)
        await client.send_goal(9)
        store.on_kept = lambda what, _goal: store.hold() if what == "accept" else None
        second = await client.send_goal(7)
        stream = await server.feedback(second.goal_id, after=0)
        await anyio.sleep(1)
        if canceled:
            tasks.start_soon(second.cancel)
            await anyio.sleep(1)
        assert second.status is GoalStatus.ACCEPTED
        assert stream.take() == ()
        store.release()
        await anyio.sleep(1)
        told = [GoalStatus.EXECUTING, GoalStatus.CANCELING] if canceled else [GoalStatus.EXECUTING]
        assert [stream.take()[0] for _ in told] == told
        assert second.status is told[-1]
        assert isinstance(stream.take()[0], FeedbackItem)


async def test_a_schedule_that_rejects_a_stored_goal_ends_it() -> None:
    def key(request: int) -> int:
        raise GoalRejected(f"no room for {request}")

    async with server_with(store_with(stored()), schedule=Schedule(concurrency=1, key=key)) as one:
        outcome = await (await attached(one)).outcome()
    assert (outcome.status, outcome.reason) == (GoalStatus.ABORTED, "no room for 3")


# Recovery


@pytest.mark.promise("KEEP-12")
@pytest.mark.parametrize(
    ("fields", "settings", "reason"),
    [
        ({"lost": 2}, {"recovery": "rerun"}, "given up after 3 attempts: the server was restarted"),
        ({}, {"recovery": "abort"}, "the server was restarted"),
        ({"checkpoint": b"\xa1x"}, {"unreadable": "abort", "recovery": "rerun"}, "Expected `int`"),
    ],
    ids=["attempts", "abort", "unreadable"],
)
async def test_a_goal_that_is_given_up_is_kept_with_its_checkpoint_and_the_reason(
    fields: dict[str, Any], settings: dict[str, Any], reason: str
) -> None:
    lost = stored(
        **{"is_running": True, "attempt": 3, "checkpoint": PAINT.goal.encode(2), **fields}
    )
    store = store_with(lost)
    async with server_with(store, **settings) as server:
        assert reason in (await (await attached(server)).outcome()).reason
    [kept] = store.goals.values()
    assert kept.is_given_up
    assert (kept.goal, kept.checkpoint, kept.attempt) == (lost.goal, lost.checkpoint, 3)
    assert kept.keep_until - kept.ended_at == 7 * 24 * 3600 * SECOND
    async with server_with(store, **settings) as server:
        assert reason in (await (await attached(server)).outcome()).reason, "its outcome is told"
    [kept] = store.goals.values()
    assert kept.is_given_up, "it stays"


async def test_a_goal_that_is_given_up_is_kept_no_longer_than_the_user_says() -> None:
    lost = stored(is_running=True, attempt=1, checkpoint=PAINT.goal.encode(2))
    store = store_with(lost)
    async with server_with(store, given_up_timeout=0) as server:
        await (await attached(server)).outcome()
    [kept] = store.goals.values()
    assert not kept.is_given_up
    assert (kept.goal, kept.checkpoint) == (b"", None)


@pytest.mark.promise("KEEP-12")
async def test_a_goal_that_was_given_up_runs_again_as_a_new_one_from_its_checkpoint() -> None:
    lost = stored(is_running=True, attempt=1, checkpoint=PAINT.goal.encode(2))
    store = store_with(lost)
    async with server_with(store) as server:
        await (await attached(server)).outcome()
    [kept] = store.goals.values()
    new = kept.as_new(time.time_ns())
    assert new.goal_id == kept.as_new(1).goal_id != kept.goal_id
    store.goals["paint", new.goal_id] = new
    async with server_with(store) as server:
        client = ActionClient(server, PAINT)
        assert await (await client.attach(new.goal_id)).result() == "painted 3 in attempt 1"
        assert [one.goal_id for one in await client.goals()] == [kept.goal_id, new.goal_id]


@pytest.mark.parametrize(
    ("goal", "obstacle"),
    [
        (stored(), ""),
        (stored(checkpoint=PAINT.goal.encode(2)), ""),
        (stored("three"), "Expected `int`"),
        (stored(checkpoint=b"\xa1x"), "Expected `int`"),
        (stored("three", status=GoalStatus.CANCELING), ""),
    ],
    ids=["fits", "checkpoint fits", "goal", "checkpoint", "canceling"],
)
@pytest.mark.parametrize("schedule", [None, Schedule(concurrency=1)], ids=["all", "schedule"])
async def test_a_server_says_whether_it_can_run_a_goal_of_another(
    goal: StoredGoal, obstacle: str, schedule: Schedule | None
) -> None:
    store = MemoryStore()
    async with server_with(store, schedule=schedule):
        found = store.obstacles["paint"](goal)
        assert found.startswith(obstacle)
        assert bool(found) == bool(obstacle)


async def test_a_goal_for_which_the_schedule_of_a_server_fails_cannot_run_there(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def key(request: int) -> int:
        raise ValueError(f"no joint {request}")

    def priority(request: int) -> float:
        raise GoalRejected(f"{request} is for nobody")

    for schedule, reason in (
        (Schedule(concurrency=1, key=key), "key failed: ValueError: no joint 3"),
        # The function ends the goal, as it wants it, at whichever server.
        (Schedule(concurrency=1, queue=1, priority=priority), ""),
    ):
        store = MemoryStore()
        async with server_with(store, schedule=schedule):
            assert store.obstacles["paint"](stored()) == reason
    assert not caplog.text, "the store tells it"


async def test_very_long_times_are_kept_as_unlimited() -> None:
    store = MemoryStore()
    async with server_with(store, result_timeout=1e12) as server:
        await (await server.send_goal(ID, PAINT.goal.encode(1), timeout=1e11)).outcome()
    [goal] = store.goals.values()
    assert (goal.deadline, goal.keep_until) == (0, 0)


async def test_a_checkpoint_of_an_action_without_checkpoints_ends_its_goal() -> None:
    plain = Action("paint", goal=int, feedback=int, result=str)
    store = store_with(stored(checkpoint=PAINT.goal.encode(1)))
    async with ActionServer(plain, paint, store=store, unreadable="abort") as server:
        outcome = await (await ActionClient(server, plain).attach(ID)).outcome()
    assert "has no checkpoints any more" in outcome.reason


async def test_an_executor_of_an_action_without_checkpoints_cannot_make_any() -> None:
    plain = Action("paint", goal=int, feedback=int, result=str)
    async with ActionServer(plain, paint, store=MemoryStore()) as server:
        with pytest.raises(GoalAborted, match="give their type to its Action, as `checkpoint=`"):
            await ActionClient(server, plain).call(1)


async def test_a_goal_that_has_ended_keeps_no_checkpoint() -> None:
    handles: list[GoalHandle[int]] = []

    async def early(goal: GoalHandle[int]) -> Painting:
        handles.append(goal)
        yield "done"

    async with ActionServer(PAINT, early, store=MemoryStore()) as server:
        await client_of(server).call(1)
        with pytest.raises(RuntimeError, match="has ended, and keeps no checkpoint"):
            await handles[0].checkpoint(1)


class Inquiry:
    """A `recovery` that answers when it is told to, and counts the goals that it is asked for."""

    def __init__(self) -> None:
        self.decide = anyio.Event()
        self.asked: list[int] = []
        self.at_once = 0
        self._waiting = 0

    async def __call__(self, goal: GoalHandle[int]) -> None:
        self.asked.append(goal.request)
        self._waiting += 1
        self.at_once = max(self.at_once, self._waiting)
        await self.decide.wait()
        self._waiting -= 1


@pytest.mark.promise("KEEP-6")
async def test_a_server_accepts_goals_while_the_function_decides() -> None:
    inquiry = Inquiry()
    store = store_with(stored(is_running=True, attempt=1))
    async with server_with(store, recovery=inquiry) as server:
        assert await client_of(server).call(1) == "painted 1 in attempt 1"
        assert inquiry.asked == [3]
        inquiry.decide.set()
        outcome = await (await attached(server)).outcome()
    assert outcome.result == "painted 3 in attempt 2"


async def test_the_function_decides_on_many_goals_at_the_same_time_and_not_on_all() -> None:
    inquiry = Inquiry()
    store = store_with(*(stored(1, n, is_running=True, attempt=1) for n in range(1, 41)))
    async with server_with(store, recovery=inquiry) as server:
        await anyio.sleep(1)
        assert len(inquiry.asked) == inquiry.at_once == ASKED_AT_ONCE < 40
        inquiry.decide.set()
        for number in range(1, 41):
            outcome = await (await attached(server, number)).outcome()
            assert outcome.result == "painted 1 in attempt 2"
    assert len(inquiry.asked) == 40


async def test_a_goal_that_is_canceled_while_the_function_decides_is_not_run_again() -> None:
    inquiry = Inquiry()
    goals = [stored(1, n, is_running=True, attempt=1) for n in range(1, ASKED_AT_ONCE + 2)]
    store = store_with(*goals)
    async with server_with(store, recovery=inquiry) as server:
        waiting = [await attached(server, n) for n in range(1, len(goals) + 1)]
        await anyio.sleep(1)
        for goal in waiting:  # the function was asked for all of them but one
            assert (await goal.cancel()).return_code is CancelCode.NONE
            assert (await goal.outcome()).status is GoalStatus.CANCELED
        inquiry.decide.set()
        assert await client_of(server).call(1) == "painted 1 in attempt 1"
    assert len(inquiry.asked) == ASKED_AT_ONCE
    assert store.goals["paint", ID].status is GoalStatus.CANCELED


async def test_a_goal_whose_fate_was_undecided_at_a_stop_is_decided_on_after_the_next_start() -> (
    None
):
    store, inquiry = store_with(stored(is_running=True, attempt=1)), Inquiry()
    for _ in range(2):
        async with server_with(store, recovery=inquiry, at_stop="keep") as server:
            goal = await attached(server)
            await anyio.sleep(1)
        with pytest.raises(GoalKept):
            await goal.outcome()
        assert store.goals["paint", ID].is_running
        assert store.goals["paint", ID].lost == 0
    inquiry.decide.set()
    async with server_with(store, recovery=inquiry, at_stop="keep") as server:
        assert (await (await attached(server)).outcome()).status is GoalStatus.SUCCEEDED
    assert inquiry.asked == [3, 3, 3]


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (True, "recovery failed: TypeError: it returned True: return None, or raise GoalAborted"),
        (ValueError("no idea"), "recovery failed: ValueError: no idea"),
        (GoalAborted("dry"), "dry"),
        (GoalAborted("dry", result=7), "recovery failed: TypeError: its result is str, not 7"),
        (GoalAborted("dry", result="\ud800"), "recovery failed: ValueError: text with half a "),
    ],
    ids=[
        "a value",
        "another error",
        "no result",
        "a result of another type",
        "a result that cannot be sent",
    ],
)
async def test_a_function_that_answers_something_else_ends_the_goal(
    answer: object, reason: str
) -> None:
    def decide(goal: GoalHandle[int]) -> Any:
        if isinstance(answer, Exception):
            raise answer
        return answer

    store = store_with(stored(is_running=True, attempt=1))
    async with server_with(store, recovery=decide) as server:
        outcome = await (await attached(server)).outcome()
    assert (outcome.status, outcome.result) == (GoalStatus.ABORTED, None)
    assert outcome.reason.startswith(reason)


async def test_a_server_whose_start_is_canceled_leaves_its_goals_in_the_store() -> None:
    def cancel_start(request: int) -> int:
        start.cancel()
        return request

    store = store_with(stored(), stored(number=2))
    schedule = Schedule(concurrency=1, key=cancel_start)
    with anyio.CancelScope() as start:
        async with server_with(store, schedule=schedule, unreadable="abort", at_stop="keep"):
            pytest.fail("it has started")
    assert [goal.status for goal in store.goals.values()] == [GoalStatus.ACCEPTED] * 2
    async with server_with(store, recovery="rerun") as server:
        assert await (await attached(server)).result() == "painted 3 in attempt 2"


async def test_an_outcome_is_remembered_as_long_as_a_client_may_need_to_come_back() -> None:
    ended = stored(status=GoalStatus.SUCCEEDED, attempt=1, ended_at=time.time_ns())
    ended.goal, ended.result = b"", PAINT.result.encode("painted")
    async with server_with(store_with(ended), result_timeout=0) as server:
        await anyio.sleep(29)
        assert await (await attached(server)).result() == "painted"
        await anyio.sleep(2)
        with pytest.raises(Exception, match="is unknown"):
            await attached(server)


async def test_a_clock_that_was_set_back_by_a_day_changes_nothing() -> None:
    tomorrow = time.time_ns() + 24 * 60 * 60 * SECOND
    ended = stored(status=GoalStatus.SUCCEEDED, attempt=1, ended_at=tomorrow)
    ended.stamp, ended.result, ended.keep_until = tomorrow, PAINT.result.encode("painted"), tomorrow
    waiting = stored(number=2)
    waiting.stamp = tomorrow + 1
    async with server_with(store_with(ended, waiting), result_timeout=100) as server:
        goal = await client_of(server).send_goal(1)
        assert [info.stamp - tomorrow for info in await client_of(server).goals()] == [0, 1, 2]
        assert await goal.result() == "painted 1 in attempt 1"
        await anyio.sleep(95)
        assert await (await attached(server)).result() == "painted"
        assert await (await attached(server, 2)).result() == "painted 3 in attempt 1"


# Stop


async def test_an_end_that_cannot_be_written_in_time_is_told_after_the_next_start() -> None:
    store = MemoryStore()
    async with server_with(store, shutdown_timeout=1) as server:
        goal = await client_of(server).send_goal(1)
        store.hold()
        await anyio.sleep(2)
        await server.stop()
        with pytest.raises(GoalKept):
            await goal.result()
        store.release()
    async with server_with(store) as server:
        outcome = await (await attached_to(server, goal.goal_id)).outcome()
    assert outcome.status in (GoalStatus.ABORTED, GoalStatus.SUCCEEDED)


async def attached_to(server: Server, goal_id: GoalID) -> ClientGoal[int, str]:
    return await client_of(server).attach(goal_id)


async def test_calls_that_wait_for_a_store_that_is_too_slow_may_be_made_again() -> None:
    store = MemoryStore()
    async with server_with(store, shutdown_timeout=1) as server:
        client = client_of(server)
        goal = await client.send_goal(9)
        store.hold()

        async with anyio.create_task_group() as tasks:
            late = "before its store has answered"
            tasks.start_soon(fails, GoalKept, late, client.send_goal, 1)
            tasks.start_soon(fails, GoalKept, late, goal.cancel)
            await anyio.sleep(1)
            await server.stop()
        store.release()


@pytest.mark.parametrize("at_stop", ["keep", "abort"])
async def test_clients_of_a_server_that_keeps_its_goals_are_to_come_back(at_stop: Any) -> None:
    async with server_with(MemoryStore(), at_stop=at_stop) as server:
        await server.stop()
        expected = GoalKept if at_stop == "keep" else ServerNotFound
        with pytest.raises(expected):
            await client_of(server).send_goal(1)


async def test_a_store_that_fails_at_the_start_is_an_error_of_the_start() -> None:
    store = store_with(stored(is_running=True, attempt=1))
    store.fate = lambda _number, _what: Fate.FAILED
    server = server_with(store)
    with pytest.raises(StoreError, match="broken"):
        async with server:
            await anyio.sleep_forever()
    with pytest.raises(GoalKept, match="store has failed"):
        await client_of(server).send_goal(1)


async def test_a_store_that_fails_while_goals_are_taken_over_is_an_error_of_the_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    let_slices_last(monkeypatch, -1.0)  # the store answers between two goals
    store = store_with(*(stored(number=n, is_running=True, attempt=1) for n in range(1, 10)))
    store.fate = lambda _number, _what: Fate.FAILED
    with pytest.raises(StoreError, match="broken"):
        async with server_with(store):
            pytest.fail("it has started")


# Time


@pytest.mark.promise("SCHEDULE-8")
async def test_the_time_in_the_queue_goes_on_while_no_server_runs() -> None:
    now = time.time_ns()
    store = store_with(
        stored(number=1, stamp=now - 300 * SECOND, attempt=1),  # it had its turn before
        stored(number=2, stamp=now - 300 * SECOND),
        stored(5, number=3, stamp=now - 60 * SECOND),
        stored(number=4, stamp=now - 98 * SECOND),
        stored(number=5, stamp=now + 300 * SECOND),  # the clock was set back
    )
    schedule = Schedule(concurrency=1, queue=9, queue_timeout=100)
    async with server_with(store, schedule=schedule) as server:
        began = current_time()
        ends = {}
        async with anyio.create_task_group() as tasks:

            async def wait_for(number: int) -> None:
                outcome = await (await attached(server, number)).outcome()
                ends[number] = outcome.result or outcome.reason, round(current_time() - began)

            for number in range(1, 6):
                tasks.start_soon(wait_for, number)
    assert ends == {
        1: ("painted 3 in attempt 2", 3),
        2: ("waited for 100 s", 0),
        3: ("painted 5 in attempt 1", 8),
        4: ("waited for 100 s", 2),
        5: ("painted 3 in attempt 1", 11),
    }

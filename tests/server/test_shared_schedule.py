"""One `Schedule` that several servers have: what they share, and how long."""

from __future__ import annotations

import threading
from collections.abc import AsyncGenerator
from typing import Any

import anyio
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    ClientGoal,
    GoalHandle,
    GoalRejected,
    GoalStatus,
    Schedule,
)
from tests.support.memory_store import MemoryStore
from tests.support.virtual_time import in_virtual_time

pytestmark = [pytest.mark.anyio, in_virtual_time()]

MOVE = Action("move", goal=float, feedback=int, result=str)
GRASP = Action("grasp", goal=float, feedback=int, result=str)
ONE: Any = {"concurrency": 1, "queue": 5}


async def work(goal: GoalHandle[float]) -> AsyncGenerator[int | str, None]:
    """Work for as many seconds as the goal says."""
    yield 0
    await anyio.sleep(goal.request)
    yield "done"


def server(
    action: Action[float, int, str], schedule: Schedule, executor: Any = work, **settings: Any
) -> ActionServer[float, int, str]:
    return ActionServer(action, executor, schedule=schedule, **settings)


def client(of: ActionServer[float, int, str]) -> ActionClient[float, int, str]:
    return ActionClient(of, of.action)


async def settled(goal: ClientGoal[int, str]) -> GoalStatus:
    """Return the status of a goal when all that is due now has happened."""
    await anyio.sleep(0.1)
    return goal.status


@pytest.mark.promise("SCHEDULE-12")
async def test_two_actions_of_one_schedule_share_its_places() -> None:
    schedule = Schedule(**ONE)
    async with server(MOVE, schedule) as move, server(GRASP, schedule) as grasp:
        first = await client(move).send_goal(10)
        second = await client(grasp).send_goal(10)
        third = await client(move).send_goal(10)
        assert await settled(second) is GoalStatus.ACCEPTED
        assert (await first.outcome()).status is GoalStatus.SUCCEEDED
        assert await settled(second) is GoalStatus.EXECUTING
        assert await settled(third) is GoalStatus.ACCEPTED
        assert (await third.outcome()).status is GoalStatus.SUCCEEDED


@pytest.mark.promise("SCHEDULE-12")
async def test_two_schedules_that_are_equal_share_nothing() -> None:
    async with (
        server(MOVE, Schedule(**ONE)) as move,
        server(GRASP, Schedule(**ONE)) as grasp,
    ):
        await client(move).send_goal(10)
        assert await settled(await client(grasp).send_goal(10)) is GoalStatus.EXECUTING


async def test_a_full_schedule_is_busy_for_each_of_its_actions() -> None:
    schedule = Schedule(total=1)
    async with server(MOVE, schedule) as move, server(GRASP, schedule) as grasp:
        await client(move).send_goal(10)
        with pytest.raises(GoalRejected, match="busy: 1 of 1 running"):
            await client(grasp).send_goal(10)


async def test_a_goal_preempts_that_of_another_action() -> None:
    schedule = Schedule(concurrency=1, when_full="preempt")
    async with server(MOVE, schedule) as move, server(GRASP, schedule) as grasp:
        first = await client(move).send_goal(10)
        second = await client(grasp).send_goal(1)
        outcome = await first.outcome()
        assert (outcome.status, outcome.reason) == (
            GoalStatus.ABORTED,
            f"preempted by {second.goal_id}",
        )
        assert (await second.outcome()).status is GoalStatus.SUCCEEDED


async def test_an_executor_cannot_take_over_a_goal_of_another_action() -> None:
    seen: list[object] = []

    async def watch(goal: GoalHandle[float]) -> AsyncGenerator[int | str, None]:
        for _ in range(20):
            yield 0
            await anyio.sleep(1)
            seen.append(goal.successor)

    schedule = Schedule(concurrency=1, when_full="preempt", handover=5)
    async with server(MOVE, schedule, watch) as move, server(GRASP, schedule) as grasp:
        first = await client(move).send_goal(10)
        second = await client(grasp).send_goal(1)
        assert (await first.outcome()).reason == f"preempted by {second.goal_id}"
        assert (await second.outcome()).status is GoalStatus.SUCCEEDED
    assert seen == [None] * len(seen) != []


@pytest.mark.promise("SCHEDULE-12")
@pytest.mark.parametrize("at_stop", ["abort", "keep"])
async def test_a_server_that_stops_gives_its_places_to_the_others(at_stop: Any) -> None:
    schedule = Schedule(**ONE, queue_timeout=100)
    async with server(GRASP, schedule) as grasp:
        async with server(MOVE, schedule, store=MemoryStore(), at_stop=at_stop) as move:
            await client(move).send_goal(1000)
            await client(move).send_goal(1000)
            waiting = await client(grasp).send_goal(10)
            assert await settled(waiting) is GoalStatus.ACCEPTED
        assert await settled(waiting) is GoalStatus.EXECUTING
        # The other server kept the time, too.
        late = await client(grasp).send_goal(1)
        forever = await client(grasp).send_goal(1000)
        assert (await late.outcome()).status is GoalStatus.SUCCEEDED
        last = await client(grasp).send_goal(1)
        assert (await last.outcome()).reason == "waited for 100 s"
        await forever.cancel()


async def test_an_executor_that_does_not_end_takes_no_place_after_its_server_has_stopped() -> None:
    over = anyio.Event()

    async def stubborn(goal: GoalHandle[float]) -> AsyncGenerator[int | str, None]:
        with anyio.CancelScope(shield=True):
            await over.wait()
        yield "done"

    schedule = Schedule(**ONE)
    async with server(GRASP, schedule, shutdown_timeout=1) as grasp:
        async with anyio.create_task_group() as tasks:

            async def end_later() -> None:
                await anyio.sleep(50)
                over.set()

            tasks.start_soon(end_later)
            async with server(MOVE, schedule, stubborn, shutdown_timeout=1) as move:
                await client(move).send_goal(1)
                goal = await client(grasp).send_goal(1)
                await anyio.sleep(1)
            assert (await goal.outcome()).status is GoalStatus.SUCCEEDED


async def test_the_same_id_is_in_use_for_the_other_action_of_a_schedule() -> None:
    schedule = Schedule(**ONE)
    async with server(MOVE, schedule) as move, server(GRASP, schedule) as grasp:
        goal = await client(move).send_goal(10)
        with pytest.raises(GoalRejected, match="another action of the same schedule has a goal of"):
            await client(grasp).send_goal(1, goal_id=goal.goal_id)
        assert (await goal.outcome()).status is GoalStatus.SUCCEEDED
        again = await client(grasp).send_goal(1, goal_id=goal.goal_id)
        assert (await again.outcome()).status is GoalStatus.SUCCEEDED


async def take_over(goal: GoalHandle[float]) -> AsyncGenerator[int | str, None]:
    """Go on as the first goal that preempts this one, and end."""
    if goal.request > 1:
        await goal.wait_for_successor()
        goal = goal.take_over()
    yield "done"


@pytest.mark.parametrize(
    ("rules", "executor"),
    [
        ({"queue": 1, "when_full": "replace"}, work),
        ({"queue": 5, "queue_timeout": 1}, work),
        ({"when_full": "preempt", "handover": 60}, take_over),
    ],
    ids=["replaced", "too late", "taken over"],
)
async def test_the_id_of_a_goal_that_has_lost_its_place_is_free_for_the_other_action(
    rules: dict[str, Any], executor: Any
) -> None:
    schedule = Schedule(concurrency=1, **rules)
    async with server(MOVE, schedule, executor) as move, server(GRASP, schedule) as grasp:
        goals = []
        for seconds in (50, 40, 1):
            goals.append(await client(move).send_goal(seconds))
            await anyio.sleep(2)
        aborted = [goal for goal in goals if goal.status is GoalStatus.ABORTED]
        assert aborted
        for goal in goals:
            await goal.cancel()
            await goal.outcome()
        for goal in aborted:
            other = await client(grasp).send_goal(0.1, goal_id=goal.goal_id)
            assert await other.result() == "done"


async def test_servers_of_one_schedule_have_the_same_shutdown_timeout() -> None:
    schedule = Schedule(**ONE)
    async with server(MOVE, schedule, shutdown_timeout=1):
        with pytest.raises(ValueError, match="the same shutdown_timeout, not 1 and 2"):
            async with server(GRASP, schedule, shutdown_timeout=2):
                pytest.fail("it has started")
    async with server(GRASP, schedule, shutdown_timeout=2) as grasp:
        assert await client(grasp).call(1) == "done"


async def test_servers_of_two_threads_cannot_share_a_schedule() -> None:
    schedule = Schedule(**ONE)
    errors: list[Exception] = []

    async def enter() -> None:
        async with server(GRASP, schedule):
            pytest.fail("it has started")

    def run() -> None:
        try:
            anyio.run(enter)
        except RuntimeError as exc:
            errors.append(exc)

    async with server(MOVE, schedule):
        thread = threading.Thread(target=run)
        thread.start()
        thread.join()
    assert "give each thread a Schedule of its own" in str(errors[0])

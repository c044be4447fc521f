"""Schedules: which goals run, wait and give way, as clients see it."""

from __future__ import annotations

import logging
from contextlib import AsyncExitStack
from typing import Any

import anyio
import pytest

from fibaction import (
    ActionClient,
    ActionServer,
    ClientGoal,
    GoalAborted,
    GoalCanceled,
    GoalHandle,
    GoalID,
    GoalInfo,
    GoalRejected,
    GoalStatus,
    Schedule,
)
from fibaction.testing.contract.executors import FIBONACCI, Feedback, Goal, Items, Result
from fibaction.testing.contract.reach import Reach

pytestmark = pytest.mark.anyio

Client = ActionClient[Goal, Feedback, Result]
Sent = ClientGoal[Feedback, Result]

ONE = Schedule(concurrency=1)
PREEMPT = Schedule(concurrency=1, when_full="preempt")


class Bench:
    """An executor that tells which goals run, and lets tests end each of them by its order."""

    def __init__(self) -> None:
        self.started: list[int] = []
        self.inside: list[int] = []
        self.most_inside = 0
        self.clean: anyio.Event | None = None
        """The event for which the clean-up of an executor waits; None if it does not wait."""
        self._go: dict[int, anyio.Event] = {}

    def let_go(self, *orders: int) -> None:
        """Let these goals end with a result."""
        for order in orders:
            self._event(order).set()

    def _event(self, order: int) -> anyio.Event:
        return self._go.setdefault(order, anyio.Event())

    async def __call__(self, goal: GoalHandle[Goal]) -> Items:
        order = goal.request.order
        self.started.append(order)
        self.inside.append(order)
        self.most_inside = max(self.most_inside, len(self.inside))
        try:
            yield Feedback([order])
            await self._event(order).wait()
            yield Result([order])
        except anyio.get_cancelled_exc_class():
            if self.clean is not None:
                await self.clean.wait()
            raise GoalCanceled("interrupted", result=Result([order, order])) from None
        finally:
            self.inside.remove(order)


async def begun(sent: Sent) -> None:
    """Wait until the executor of a goal has begun."""
    async for _ in sent.feedback:
        return


async def send(client: Client, *orders: int) -> list[Sent]:
    """Send goals one after another; none of them needs to begin."""
    return [await client.send_goal(Goal(order)) for order in orders]


async def listed(client: Client, goals: list[Sent], *statuses: GoalStatus) -> None:
    """Wait until the server lists these goals with these statuses; over ROS 2 that takes time."""
    missing = {goal.goal_id: status for goal, status in zip(goals, statuses, strict=True)}
    async with client.events(feedback=False) as events:
        async for event in events:
            if isinstance(event, GoalInfo) and missing.get(event.goal_id) is event.status:
                del missing[event.goal_id]
            if not missing:
                return


async def ended(sent: Sent) -> GoalStatus:
    return (await sent.outcome()).status


# Places


@pytest.mark.promise("SCHEDULE-1", "SCHEDULE-2")
async def test_goals_beyond_the_limit_wait_as_accepted_and_start_in_their_order(
    reach: Reach,
) -> None:
    bench = Bench()
    server = ActionServer(FIBONACCI, bench, schedule=Schedule(concurrency=2, queue=3))
    async with reach(server) as client:
        sent = await send(client, 1, 2, 3, 4, 5)
        await begun(sent[1])
        await listed(client, sent, *[GoalStatus.EXECUTING] * 2, *[GoalStatus.ACCEPTED] * 3)
        assert [one.status for one in sent[2:]] == [GoalStatus.ACCEPTED] * 3
        assert bench.started == [1, 2]
        follower = await client.attach(sent[2].goal_id)
        bench.let_go(2)
        await begun(sent[2])
        assert bench.started == [1, 2, 3]
        bench.let_go(1, 3, 4, 5)
        assert [await one.result() for one in sent] == [Result([n]) for n in range(1, 6)]
        assert await follower.result() == Result([3])
        assert bench.started == [1, 2, 3, 4, 5]
        assert bench.most_inside == 2


@pytest.mark.promise("SCHEDULE-1")
async def test_each_key_has_places_of_its_own_within_the_total(reach: Reach) -> None:
    bench = Bench()
    schedule = Schedule(concurrency=1, queue=2, total=2, key=lambda goal: goal.order // 10)
    async with reach(ActionServer(FIBONACCI, bench, schedule=schedule)) as client:
        sent = await send(client, 10, 11, 20, 30)
        await begun(sent[2])
        assert sorted(bench.started) == [10, 20]
        bench.let_go(20)
        await begun(sent[3])
        assert sorted(bench.started) == [10, 20, 30]
        bench.let_go(10)
        await begun(sent[1])
        bench.let_go(11, 30)
        assert [await ended(one) for one in sent] == [GoalStatus.SUCCEEDED] * 4
        assert bench.most_inside == 2


@pytest.mark.promise("SCHEDULE-3")
async def test_a_goal_canceled_while_it_waits_ends_at_once_and_gives_its_place_back(
    reach: Reach,
) -> None:
    bench = Bench()
    server = ActionServer(FIBONACCI, bench, schedule=Schedule(concurrency=1, queue=1))
    async with reach(server) as client:
        first, second = await send(client, 1, 2)
        await begun(first)
        answer = await second.cancel()
        assert answer.accepted
        outcome = await second.outcome()
        assert (outcome.status, outcome.result) == (GoalStatus.CANCELED, None)
        await listed(client, [first, second], GoalStatus.EXECUTING, GoalStatus.CANCELED)
        (third,) = await send(client, 3)
        bench.let_go(1, 3)
        assert await third.result() == Result([3])
        assert bench.started == [1, 3]


@pytest.mark.promise("SCHEDULE-4")
async def test_a_goal_without_a_place_is_rejected_and_accepted_when_it_is_sent_again_later(
    reach: Reach,
) -> None:
    bench = Bench()
    server = ActionServer(FIBONACCI, bench, schedule=Schedule(concurrency=1, queue=1))
    async with reach(server) as client:
        first, second = await send(client, 1, 2)
        goal_id = GoalID.random()
        with pytest.raises(GoalRejected):
            await client.send_goal(Goal(3), goal_id=goal_id)
        bench.let_go(1)
        await first.result()
        third = await client.send_goal(Goal(3), goal_id=goal_id)
        bench.let_go(2, 3)
        await second.result()
        assert await third.result() == Result([3])


@pytest.mark.promise("SCHEDULE-4")
async def test_a_goal_without_a_place_is_told_how_many_run_and_wait(reach: Reach) -> None:
    server = ActionServer(FIBONACCI, Bench(), schedule=ONE)
    async with reach(server) as client:
        await client.send_goal(Goal(1))
        with pytest.raises(GoalRejected) as caught:
            await client.send_goal(Goal(2))
        assert caught.value.reason == "busy: 1 of 1 running, 0 of 0 waiting"


@pytest.mark.promise("SCHEDULE-7")
async def test_the_most_urgent_goal_starts_first_and_preempts_none(reach: Reach) -> None:
    bench = Bench()
    schedule = Schedule(concurrency=1, queue=5, priority=lambda goal: goal.order % 10)
    async with reach(ActionServer(FIBONACCI, bench, schedule=schedule)) as client:
        sent = await send(client, 15, 27, 31, 43, 51)
        bench.let_go(15, 27, 31, 43, 51)
        assert [await ended(one) for one in sent] == [GoalStatus.SUCCEEDED] * 5
        assert bench.started == [15, 27, 43, 31, 51]


@pytest.mark.promise("STATUS-9")
@pytest.mark.parametrize("is_followed", [False, True], ids=["list", "list and events"])
async def test_a_list_of_goals_tells_the_places_of_those_that_wait(
    reach: Reach, is_followed: bool
) -> None:
    bench = Bench()
    schedule = Schedule(concurrency=1, queue=5, priority=lambda goal: -goal.order)
    server = ActionServer(FIBONACCI, bench, schedule=schedule)
    async with reach(server) as client, AsyncExitStack() as stack:
        if is_followed:  # on the same connection, before any goal waits
            await stack.enter_async_context(client.events())
        sent = await send(client, 1, 9, 5)
        await begun(sent[0])
        assert await places(client, sent) == [(0, 0), (2, 2), (1, 2)]
        sent += await send(client, 7)
        assert await places(client, sent) == [(0, 0), (3, 3), (1, 3), (2, 3)]
        bench.let_go(1)
        await begun(sent[2])
        assert await places(client, sent) == [(0, 0), (2, 2), (0, 0), (1, 2)]
        await sent[3].cancel()
        assert await places(client, sent) == [(0, 0), (1, 1), (0, 0), (0, 0)]


async def places(client: Client, goals: list[Sent]) -> list[tuple[int, int]]:
    infos = {info.goal_id: info for info in await client.goals()}
    for info in infos.values():
        assert (info.status is GoalStatus.ACCEPTED) == (info.place > 0)
    return [(infos[goal.goal_id].place, infos[goal.goal_id].queue_length) for goal in goals]


# Giving way


@pytest.mark.promise("SCHEDULE-5")
async def test_a_new_goal_preempts_the_one_that_runs_and_waits_for_its_clean_up(
    reach: Reach,
) -> None:
    bench = Bench()
    bench.clean = anyio.Event()
    async with reach(ActionServer(FIBONACCI, bench, schedule=PREEMPT)) as client:
        old = await client.send_goal(Goal(1))
        await begun(old)
        new = await client.send_goal(Goal(2))
        await listed(client, [old, new], GoalStatus.EXECUTING, GoalStatus.ACCEPTED)
        assert bench.inside == [1]
        bench.clean.set()
        outcome = await old.outcome()
        assert (outcome.status, outcome.result) == (GoalStatus.ABORTED, Result([1, 1]))
        bench.let_go(2)
        assert await new.result() == Result([2])
        assert bench.started == [1, 2]
        assert bench.most_inside == 1


@pytest.mark.promise("SCHEDULE-5")
async def test_the_newest_goal_of_several_that_preempt_runs_and_the_others_never_do(
    reach: Reach,
) -> None:
    bench = Bench()
    bench.clean = anyio.Event()
    async with reach(ActionServer(FIBONACCI, bench, schedule=PREEMPT)) as client:
        (first,) = await send(client, 1)
        await begun(first)
        *others, last = await send(client, 2, 3, 4)
        bench.clean.set()
        bench.let_go(4)
        assert await last.result() == Result([4])
        assert [await ended(one) for one in (first, *others)] == [GoalStatus.ABORTED] * 3
        assert bench.started == [1, 4]


@pytest.mark.promise("SCHEDULE-5")
async def test_a_preempted_goal_is_told_by_which(reach: Reach) -> None:
    bench = Bench()
    bench.clean = anyio.Event()
    async with reach(ActionServer(FIBONACCI, bench, schedule=PREEMPT)) as client:
        (first,) = await send(client, 1)
        await begun(first)
        second, third = await send(client, 2, 3)
        bench.clean.set()
        bench.let_go(3)
        assert (await second.outcome()).reason == f"preempted by {third.goal_id}"
        # Its executor gives a reason of its own for its part of the result; the server's counts.
        with pytest.raises(GoalAborted) as caught:
            await first.result()
        assert caught.value.reason == f"preempted by {second.goal_id}"
        assert caught.value.result == Result([1, 1])


@pytest.mark.promise("SCHEDULE-5", "SCHEDULE-7")
async def test_with_a_priority_only_a_more_urgent_goal_preempts(reach: Reach) -> None:
    bench = Bench()
    schedule = Schedule(
        concurrency=1, queue=1, when_full="preempt", priority=lambda goal: goal.order
    )
    async with reach(ActionServer(FIBONACCI, bench, schedule=schedule)) as client:
        running, waiting = await send(client, 5, 4)
        await begun(running)
        with pytest.raises(GoalRejected):
            await client.send_goal(Goal(5))
        (urgent,) = await send(client, 9)
        await begun(urgent)
        assert await ended(running) is GoalStatus.ABORTED
        bench.let_go(9, 4)
        assert await ended(waiting) is GoalStatus.SUCCEEDED
        assert bench.started == [5, 9, 4]


@pytest.mark.promise("SCHEDULE-6")
async def test_the_newest_waiting_goal_is_replaced(reach: Reach) -> None:
    bench = Bench()
    schedule = Schedule(concurrency=1, queue=1, when_full="replace")
    async with reach(ActionServer(FIBONACCI, bench, schedule=schedule)) as client:
        sent = await send(client, 1, 2, 3)
        assert await ended(sent[1]) is GoalStatus.ABORTED
        bench.let_go(1, 3)
        assert [await ended(one) for one in sent[::2]] == [GoalStatus.SUCCEEDED] * 2
        assert bench.started == [1, 3]


@pytest.mark.promise("SCHEDULE-6")
async def test_a_replaced_goal_is_told_by_which(reach: Reach) -> None:
    schedule = Schedule(concurrency=1, queue=1, when_full="replace")
    async with reach(ActionServer(FIBONACCI, Bench(), schedule=schedule)) as client:
        _, second, third = await send(client, 1, 2, 3)
        assert (await second.outcome()).reason == f"replaced by {third.goal_id}"


@pytest.mark.promise("SCHEDULE-10")
async def test_an_executor_takes_its_successor_over_without_an_interruption(reach: Reach) -> None:
    moved: list[int] = []

    async def drive(goal: GoalHandle[Goal]) -> Items:
        yield Feedback([goal.request.order])
        successor = await goal.wait_for_successor()
        moved.append(successor.request.order)
        assert goal.successor is successor
        old, goal = goal, goal.take_over()
        assert goal is successor
        assert old.status is GoalStatus.ABORTED
        assert old.successor is None
        yield Feedback([goal.request.order])
        yield Result([goal.request.order])

    schedule = Schedule(concurrency=1, when_full="preempt", handover=60)
    async with reach(ActionServer(FIBONACCI, drive, schedule=schedule)) as client:
        old = await client.send_goal(Goal(1))
        await begun(old)
        new = await client.send_goal(Goal(2))
        assert await new.result() == Result([2])
        assert await ended(old) is GoalStatus.ABORTED
        assert [item async for item in new.feedback] == [Feedback([2])]
        assert moved == [2]


@pytest.mark.promise("SCHEDULE-10")
async def test_an_executor_that_does_not_take_over_in_time_is_interrupted(reach: Reach) -> None:
    bench = Bench()
    schedule = Schedule(concurrency=1, when_full="preempt", handover=0.01)
    async with reach(ActionServer(FIBONACCI, bench, schedule=schedule)) as client:
        old = await client.send_goal(Goal(1))
        await begun(old)
        new = await client.send_goal(Goal(2))
        assert await ended(old) is GoalStatus.ABORTED
        bench.let_go(2)
        assert await new.result() == Result([2])


@pytest.mark.promise("SCHEDULE-10")
async def test_a_goal_whose_successor_is_canceled_goes_on(reach: Reach) -> None:
    bench = Bench()
    schedule = Schedule(concurrency=1, when_full="preempt", handover=60)
    async with reach(ActionServer(FIBONACCI, bench, schedule=schedule)) as client:
        old = await client.send_goal(Goal(1))
        await begun(old)
        new = await client.send_goal(Goal(2))
        await new.cancel()
        assert await ended(new) is GoalStatus.CANCELED
        bench.let_go(1)
        assert await old.result() == Result([1])
        assert bench.started == [1]


# Timeouts


@pytest.mark.promise("SCHEDULE-8")
async def test_a_goal_that_has_waited_too_long_is_aborted(reach: Reach) -> None:
    bench = Bench()
    schedule = Schedule(concurrency=1, queue=2, queue_timeout=0.01)
    async with reach(ActionServer(FIBONACCI, bench, schedule=schedule)) as client:
        running, waiting = await send(client, 1, 2)
        outcome = await waiting.outcome()
        assert (outcome.status, outcome.result) == (GoalStatus.ABORTED, None)
        bench.let_go(1)
        assert await running.result() == Result([1])
        assert bench.started == [1]


@pytest.mark.promise("SCHEDULE-9")
async def test_an_executor_that_takes_too_long_is_interrupted_and_hands_over_what_it_has(
    reach: Reach,
) -> None:
    bench = Bench()
    schedule = Schedule(concurrency=1, queue=1, run_timeout=0.2)
    async with reach(ActionServer(FIBONACCI, bench, schedule=schedule)) as client:
        sent = await send(client, 1, 2)
        for order, one in enumerate(sent, 1):
            outcome = await one.outcome()
            assert (outcome.status, outcome.result) == (
                GoalStatus.ABORTED,
                Result([order, order]),
            )


@pytest.mark.promise("SCHEDULE-8", "SCHEDULE-9")
async def test_a_goal_that_is_too_late_is_told_how_long_it_had(reach: Reach) -> None:
    schedule = Schedule(concurrency=1, queue=1, queue_timeout=0.01, run_timeout=0.5)
    async with reach(ActionServer(FIBONACCI, Bench(), schedule=schedule)) as client:
        running, waiting = await send(client, 1, 2)
        assert (await waiting.outcome()).reason == "waited for 0.01 s"
        assert (await running.outcome()).reason == "took longer than 0.5 s"


@pytest.mark.promise("SCHEDULE-9")
async def test_a_clean_up_that_takes_too_long_is_killed_and_its_place_is_free_again(
    reach: Reach, caplog: pytest.LogCaptureFixture
) -> None:
    bench = Bench()
    bench.clean = anyio.Event()  # which is never set
    server = ActionServer(FIBONACCI, bench, schedule=PREEMPT, shutdown_timeout=0.01)
    with caplog.at_level(logging.WARNING, "fibaction.server"):
        async with reach(server) as client:
            old = await client.send_goal(Goal(1))
            await begun(old)
            new = await client.send_goal(Goal(2))
            outcome = await old.outcome()
            assert (outcome.status, outcome.result) == (GoalStatus.ABORTED, None)
            bench.let_go(2)
            assert await new.result() == Result([2])
            assert bench.most_inside == 1
    assert f"goal {old.goal_id} of action 'fibonacci' did not stop in time (0.01 s)" in caplog.text


# Functions of the schedule


def broken(_: Any) -> Any:
    raise LookupError("no such arm")


FUNCTIONS: dict[str, tuple[Schedule, str]] = {
    "a key that fails": (
        Schedule(concurrency=1, key=broken),
        "key failed: LookupError: no such arm",
    ),
    "a key that is not hashable": (
        Schedule(concurrency=1, key=lambda goal: [goal.order]),  # type: ignore[arg-type]  # as below
        "key failed: TypeError: unhashable type: 'list'",
    ),
    "a key that has to be awaited": (
        Schedule(concurrency=1, key=lambda goal: anyio.sleep(goal.order)),  # type: ignore[arg-type]  # as below
        "key failed: TypeError: it returned something to await, and not a value",
    ),
    "a key that cannot be found again": (
        Schedule(concurrency=1, key=lambda goal: float("nan")),
        "key failed: ValueError: it returned nan, which is not equal to itself",
    ),
    "a priority that fails": (
        Schedule(concurrency=1, priority=broken),
        "priority failed: LookupError: no such arm",
    ),
    "a priority that is not a number": (
        Schedule(concurrency=1, priority=lambda goal: "high"),  # type: ignore[arg-type]  # as programs without types do
        "priority failed: TypeError: it returned 'high', which is not a number",
    ),
    "a priority that has no order": (
        Schedule(concurrency=1, priority=lambda goal: float("nan")),
        "priority failed: ValueError: it returned nan, which is not before or after any number",
    ),
}


@pytest.mark.promise("SCHEDULE-11")
@pytest.mark.parametrize("schedule", [case[0] for case in FUNCTIONS.values()], ids=list(FUNCTIONS))
async def test_a_goal_is_rejected_if_a_function_of_the_schedule_fails(
    reach: Reach, schedule: Schedule, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.ERROR, "fibaction.server"):
        async with reach(ActionServer(FIBONACCI, Bench(), schedule=schedule)) as client:
            with pytest.raises(GoalRejected):
                await client.send_goal(Goal(1))
            assert await client.goals() == []
    assert " failed: " in caplog.text


@pytest.mark.promise("SCHEDULE-11")
async def test_a_function_of_the_schedule_may_reject_a_goal_itself(
    reach: Reach, caplog: pytest.LogCaptureFixture
) -> None:
    def key(goal: Goal) -> int:
        if goal.order < 0:
            raise GoalRejected("there is no such arm")
        return goal.order

    bench = Bench()
    schedule = Schedule(concurrency=1, key=key)
    with caplog.at_level(logging.ERROR, "fibaction.server"):
        async with reach(ActionServer(FIBONACCI, bench, schedule=schedule)) as client:
            with pytest.raises(GoalRejected):
                await client.send_goal(Goal(-1))
            bench.let_go(1)
            assert await client.call(Goal(1)) == Result([1])
    assert not caplog.records


@pytest.mark.promise("SCHEDULE-11")
@pytest.mark.parametrize(("schedule", "reason"), FUNCTIONS.values(), ids=list(FUNCTIONS))
async def test_a_goal_is_told_which_function_of_the_schedule_has_failed(
    reach: Reach, schedule: Schedule, reason: str
) -> None:
    async with reach(ActionServer(FIBONACCI, Bench(), schedule=schedule)) as client:
        with pytest.raises(GoalRejected) as caught:
            await client.send_goal(Goal(1))
        assert caught.value.reason == reason

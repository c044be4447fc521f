"""Design, section 4, "Feedback"."""

from __future__ import annotations

import math
from typing import Any

import anyio
import pytest

from fibaction import ActionServer, GoalFeedback, GoalHandle, GoalInfo, GoalStatus
from fibaction.testing.contract.executors import (
    FIBONACCI,
    Feedback,
    Form,
    Goal,
    Items,
    Result,
    Steps,
)
from fibaction.testing.contract.reach import Reach

pytestmark = pytest.mark.anyio


def numbers(feedback: list[Feedback]) -> list[int]:
    return [item.partial_sequence[0] for item in feedback]


@pytest.mark.promise("GOAL-2", "FEEDBACK-1", "FEEDBACK-2")
async def test_all_feedback_arrives_in_order_however_slowly_it_is_read(
    reach: Reach, form: Form
) -> None:
    executor = Steps(go=True)
    server = ActionServer(FIBONACCI, form(executor), feedback_window=4, stall_timeout=math.inf)
    async with reach(server) as client, client.send_goal(Goal(100)) as goal:
        seen = []
        async for item in goal.feedback:
            for _ in range(3):
                await anyio.lowlevel.checkpoint()
            seen.append(item)
        assert await goal.result() == Result([100])
    assert numbers(seen) == list(range(1, 101))
    assert goal.feedback_dropped == 0


@pytest.mark.promise("FEEDBACK-2", "FEEDBACK-3")
async def test_the_executor_waits_at_its_yield_for_a_client_that_does_not_read(
    reach: Reach,
    form: Form,
) -> None:
    executor = Steps(go=True)
    server = ActionServer(FIBONACCI, form(executor), feedback_window=4, stall_timeout=math.inf)
    async with reach(server) as client, client.send_goal(Goal(1000)) as goal:
        await anyio.wait_all_tasks_blocked()
        waited_at = executor.yielded
        seen = [item async for item in goal.feedback]
    assert waited_at < 1000
    assert numbers(seen) == list(range(1, 1001))


@pytest.mark.promise("FEEDBACK-4")
async def test_a_client_that_stalls_loses_the_oldest_and_is_told_how_many(
    reach: Reach, form: Form
) -> None:
    executor = Steps()
    server = ActionServer(FIBONACCI, form(executor), feedback_window=4, stall_timeout=0.01)
    async with reach(server) as client, client.send_goal(Goal(1000)) as goal:
        with await client.endpoint.status() as statuses:
            executor.go.set()
            while (info := await statuses.receive()) is not None:
                if info.status.is_terminal:
                    break
        seen = numbers([item async for item in goal.feedback])
        assert await goal.result() == Result([1000])
    assert seen == sorted(set(seen))
    assert seen[-1] == 1000
    assert goal.feedback_dropped == 1000 - len(seen) > 0


@pytest.mark.promise("FEEDBACK-5")
async def test_a_client_that_has_caught_up_loses_nothing_again(reach: Reach) -> None:
    pause, paused = anyio.Event(), anyio.Event()

    async def in_two_parts(goal: GoalHandle[Goal]) -> Items:
        for number in range(1, 1001):
            yield Feedback([number])
        paused.set()
        await pause.wait()
        for number in range(1001, 1101):
            yield Feedback([number])
        yield Result([])

    server = ActionServer(FIBONACCI, in_two_parts, feedback_window=4, stall_timeout=0.01)
    async with reach(server) as client, client.send_goal(Goal(0)) as goal:
        await paused.wait()
        seen = []
        async for item in goal.feedback:
            seen.extend(numbers([item]))
            if seen[-1] == 1000:
                dropped = goal.feedback_dropped
                pause.set()
    assert dropped > 0
    assert seen[-100:] == list(range(1001, 1101))
    assert goal.feedback_dropped == dropped


@pytest.mark.promise("FEEDBACK-6")
async def test_awaiting_the_result_without_reading_does_not_hold_the_executor_up(
    reach: Reach,
) -> None:
    executor = Steps(go=True)
    server = ActionServer(FIBONACCI, executor, feedback_window=4, stall_timeout=math.inf)
    async with reach(server) as client:
        goal = await client.send_goal(Goal(1000))
        assert await goal.result() == Result([1000])

        async with client.send_goal(Goal(1000)) as goal:
            async for item in goal.feedback:
                if item.partial_sequence == [5]:
                    break
            assert await goal.result() == Result([1000])


@pytest.mark.promise("FEEDBACK-7")
async def test_awaiting_the_result_beside_the_reader_loses_nothing(reach: Reach) -> None:
    executor = Steps(go=True)
    server = ActionServer(FIBONACCI, executor, feedback_window=4, stall_timeout=math.inf)
    seen: list[Feedback] = []

    async def read() -> None:
        async for item in goal.feedback:
            await anyio.lowlevel.checkpoint()
            seen.append(item)

    async with reach(server) as client, client.send_goal(Goal(200)) as goal:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(read)
            await anyio.wait_all_tasks_blocked()
            assert await goal.result() == Result([200])
    assert numbers(seen) == list(range(1, 201))


@pytest.mark.promise("FEEDBACK-6")
async def test_reading_on_after_the_result_was_awaited_in_vain_holds_the_executor_again(
    reach: Reach,
) -> None:
    executor = Steps()
    server = ActionServer(FIBONACCI, executor, feedback_window=4, stall_timeout=math.inf)
    async with reach(server) as client, client.send_goal(Goal(3)) as goal:
        with anyio.move_on_after(0.01) as patience:
            await goal.result()
        assert patience.cancelled_caught
        executor.go.set()
        assert numbers([item async for item in goal.feedback]) == [1, 2, 3]
        assert await goal.result() == Result([3])


@pytest.mark.promise("FEEDBACK-8")
async def test_a_goal_that_is_not_followed_any_more_is_not_held_up(reach: Reach) -> None:
    executor = Steps(go=True)
    server = ActionServer(FIBONACCI, executor, feedback_window=4, stall_timeout=math.inf)
    async with reach(server) as client:
        goal_id = (await client.send_goal(Goal(1000))).goal_id
        outcome = await client.endpoint.get_result(goal_id)
        assert outcome.status is GoalStatus.SUCCEEDED


@pytest.mark.promise("FEEDBACK-9")
async def test_latest_never_waits_and_a_slow_reader_sees_the_newest(
    reach: Reach, form: Form
) -> None:
    executor = Steps()
    server = ActionServer(
        FIBONACCI, form(executor), feedback="latest", feedback_window=4, stall_timeout=math.inf
    )
    async with reach(server) as client, client.send_goal(Goal(1000)) as goal:
        with anyio.fail_after(30):
            while executor.yielded < 1000:
                await anyio.lowlevel.checkpoint()
        await anyio.wait_all_tasks_blocked()
        executor.go.set()
        seen = numbers([item async for item in goal.feedback])
        assert await goal.result() == Result([1000])
    assert seen[-1] == 1000
    assert len(seen) < 100
    assert goal.feedback_dropped == 1000 - len(seen)


@pytest.mark.promise("FEEDBACK-10")
async def test_an_observer_follows_from_now_on_and_does_not_slow_the_goal_down(
    reach: Reach,
) -> None:
    pause, paused = anyio.Event(), anyio.Event()

    async def in_two_parts(goal: GoalHandle[Goal]) -> Items:
        yield Feedback([1])
        paused.set()
        await pause.wait()
        for number in range(2, 1001):
            yield Feedback([number])
        yield Result([7])

    server = ActionServer(FIBONACCI, in_two_parts, feedback_window=4, stall_timeout=math.inf)
    async with reach(server) as client:
        mine = await client.send_goal(Goal(0))
        await paused.wait()
        reader = await client.attach(mine.goal_id)
        sleeper = await client.attach(mine.goal_id)
        assert reader.status is GoalStatus.EXECUTING
        assert reader.stamp == mine.stamp
        pause.set()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(_read_all, mine)
            seen = numbers([item async for item in reader.feedback])
        # The sleeper has not read at all, and gets the last that is remembered.
        rest = numbers([item async for item in sleeper.feedback])
        assert await sleeper.result() == await reader.result() == Result([7])
    assert seen[0] >= 2
    assert seen == sorted(set(seen))
    assert reader.feedback_dropped == 999 - len(seen)
    assert rest[-1] == 1000
    assert sleeper.feedback_dropped == 999 - len(rest) > 0


@pytest.mark.promise("FEEDBACK-13")
async def test_another_client_that_sends_a_running_goal_again_observes_it(reach: Reach) -> None:
    executor = Steps(go=True)
    server = ActionServer(FIBONACCI, executor, feedback_window=4, stall_timeout=math.inf)
    async with reach.two_clients(server) as (mine, theirs):
        goal = await mine.send_goal(Goal(1000))
        again = await theirs.send_goal(Goal(1000), goal_id=goal.goal_id)
        assert again.stamp == goal.stamp
        # The other one reads nothing, and the executor does not wait for it.
        assert numbers([item async for item in goal.feedback]) == list(range(1, 1001))
        seen = numbers([item async for item in again.feedback])
        assert await again.result() == await goal.result() == Result([1000])
    assert seen[-1] == 1000
    assert again.feedback_dropped == 1000 - len(seen) > 0


@pytest.mark.promise("FEEDBACK-14")
async def test_an_observer_gets_the_goal_itself_while_it_is_active(reach: Reach) -> None:
    executor = Steps()
    async with reach.two_clients(ActionServer(FIBONACCI, executor)) as (mine, theirs):
        goal = await mine.send_goal(Goal(3))
        with await theirs.endpoint.feedback(goal.goal_id) as stream:
            assert stream.goal == FIBONACCI.goal.encode(Goal(3))
        executor.go.set()
        assert await goal.result() == Result([3])


async def _read_all(goal: Any) -> None:
    async for _ in goal.feedback:
        pass


@pytest.mark.promise("FEEDBACK-1", "FEEDBACK-11")
async def test_an_observer_may_ask_for_what_was_before(reach: Reach) -> None:
    executor = Steps()
    server = ActionServer(FIBONACCI, executor, feedback_window=4)
    async with reach(server) as client, client.send_goal(Goal(10)) as goal:
        async for item in goal.feedback:
            if item.partial_sequence == [10]:
                break
        late = await client.attach(goal.goal_id, after=8)
        later = await client.attach(goal.goal_id, after=0)
        future = await client.attach(goal.goal_id, after=99)
        executor.go.set()
        assert numbers([item async for item in late.feedback]) == [9, 10]
        assert late.feedback_dropped == 0
        assert numbers([item async for item in later.feedback]) == [7, 8, 9, 10]
        assert later.feedback_dropped == 6
        assert numbers([item async for item in future.feedback]) == []
        assert await goal.result() == Result([10])


@pytest.mark.promise("FEEDBACK-11")
async def test_the_feedback_of_a_goal_that_has_ended_can_be_asked_for(reach: Reach) -> None:
    server = ActionServer(FIBONACCI, Steps(go=True), feedback_window=4)
    async with reach(server) as client:
        goal = await client.send_goal(Goal(10))
        await goal.result()
        for after, seen, dropped in ((8, [9, 10], 0), (0, [7, 8, 9, 10], 6), (10, [], 0)):
            late = await client.attach(goal.goal_id, after=after)
            assert numbers([item async for item in late.feedback]) == seen
            assert late.feedback_dropped == dropped
        again = await client.send_goal(Goal(10), goal_id=goal.goal_id)
        times = [again.feedback.at async for _ in again.feedback]
        ended_at = (await again.outcome()).ended_at
        assert ended_at is not None
        # When it was reported, and not when it has arrived.
        assert [again.stamp, *times, ended_at] == sorted([again.stamp, *times, ended_at])
        assert len(times) == 4


@pytest.mark.promise("FEEDBACK-11")
async def test_a_watcher_of_all_goals_sees_the_feedback_of_one_that_ends_at_once(
    reach: Reach,
) -> None:
    executor = Steps(go=True)
    seen: list[object] = []
    async with reach(ActionServer(FIBONACCI, executor)) as client, client.events() as events:
        await client.call(Goal(3))
        async for event in events:
            if isinstance(event, GoalFeedback):
                seen.append(event.feedback.partial_sequence[0])
            elif isinstance(event, GoalInfo):
                seen.append(event.status.name)
            if seen[-1] == "SUCCEEDED":
                break
    assert seen == ["ACCEPTED", "EXECUTING", 1, 2, 3, "SUCCEEDED"]


@pytest.mark.promise("FEEDBACK-12")
async def test_a_goal_whose_feedback_is_not_read_delays_no_other_goal(reach: Reach) -> None:
    stuck, quick = Steps(), Steps(go=True)
    executors = {1: stuck, 2: quick}

    def choose(goal: GoalHandle[Goal]) -> Items:
        return executors[1 if goal.request.order == 500 else 2](goal)

    server = ActionServer(FIBONACCI, choose, feedback_window=4, stall_timeout=math.inf)
    async with reach(server) as client, client.send_goal(Goal(500)) as unread:
        await anyio.wait_all_tasks_blocked()
        async with client.send_goal(Goal(50)) as read:
            seen = numbers([item async for item in read.feedback])
            assert await read.result() == Result([50])
        assert stuck.yielded < 500
        answer = await unread.cancel()
        assert answer.accepted
        assert (await unread.outcome()).status is GoalStatus.CANCELED
    assert seen == list(range(1, 51))

"""`fibaction.server.goal_logs`: the time for which goals are remembered, and what may be held."""

from __future__ import annotations

import gc
import math
import tracemalloc
from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Any

import anyio
import pytest
from hypothesis import given, settings, strategies

from fibaction import (
    ActionServer,
    GoalHandle,
    GoalID,
    GoalInfo,
    GoalRejected,
    GoalStatus,
    UnknownGoal,
)
from fibaction.border.abc import FeedbackItem, GoalRequest, GoalStream, StatusStream
from fibaction.border.byte_budgets import ByteBudget
from fibaction.server import goal_logs
from fibaction.server.goal_logs import EXPIRY_STEP
from fibaction.words.goals import Sender
from tests.server.held import Gate, Held, packed, result, start_many, waited_for
from tests.support.executors import Items
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.support.virtual_time import in_virtual_time

pytestmark = pytest.mark.anyio


# Expiry


@in_virtual_time()
async def test_many_goals_are_forgotten_in_several_turns_before_the_rest_is_listed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(goal_logs, "FORGOTTEN_AT_ONCE", 3)
    async with ActionServer(FIBONACCI, fibonacci, result_timeout=10) as server:
        with await server.status() as before:
            for _ in range(7):
                await (await server.send_goal(GoalID.random(), packed(1))).outcome()
            await anyio.sleep(10)
            assert (await server.status()).known == 0
            told = [await before.receive() for _ in range(28)]
    assert [info.status for info in told if info is not None][21:] == [GoalStatus.UNKNOWN] * 7


@in_virtual_time()
async def test_what_was_sent_can_be_read_as_long_as_the_result_and_gives_way_before_it() -> None:
    async def sent(goal_id: GoalID) -> bytes | None:
        with await server.feedback(goal_id) as stream:
            return stream.goal

    async def one_that_ends() -> GoalID:
        goal_id = GoalID.random()
        with await server.send_goal(goal_id, packed(0), feedback=False) as stream:
            await stream.outcome()
        return goal_id

    async with ActionServer(FIBONACCI, fibonacci, result_timeout=3600) as server:
        first = await one_that_ends()
        await anyio.sleep(3599)
        assert await sent(first) == packed(0)
        size = len((await server.get_result(first)).result or b"")
        await anyio.sleep(1 + EXPIRY_STEP)
        with pytest.raises(UnknownGoal):
            await sent(first)
    most = 4 * size + 3 * len(packed(0))
    async with ActionServer(FIBONACCI, fibonacci, max_bytes=most) as server:
        goals = [await one_that_ends() for _ in range(3)]
        assert [await sent(one) for one in goals] == [packed(0)] * 3
        goals.append(await one_that_ends())
        assert [await sent(one) for one in goals] == [None, *[packed(0)] * 3]
        ends = [(await server.get_result(one)).status for one in goals]
        assert ends == [GoalStatus.SUCCEEDED] * 4


@in_virtual_time()
async def test_a_client_that_keeps_its_streams_does_not_keep_what_it_has_sent() -> None:
    async def one_that_ends() -> GoalStream:
        stream = await server.send_goal(GoalID.random(), packed(0), feedback=False)
        await stream.outcome()
        return stream

    async with ActionServer(FIBONACCI, fibonacci, result_timeout=5) as server:
        budget, results = budget_of(server), server._parts.registry.results
        expired = await one_that_ends()
        assert expired.goal == packed(0)
        await anyio.sleep(5 + EXPIRY_STEP)
        size = len((await expired.outcome()).result or b"")
        assert expired.goal is None
        assert (budget.used, results.unread_size) == (size, size)
        given_way = await one_that_ends()
        budget.limit = 3 * size
        last = await one_that_ends()
        assert [one.goal for one in (expired, given_way, last)] == [None] * 3
        assert budget.used == 3 * size
        assert [(await one.outcome()).reason for one in (expired, given_way, last)] == [""] * 3


@pytest.mark.promise("FEEDBACK-11")
@in_virtual_time()
async def test_feedback_stays_as_long_as_the_result_and_gives_way_before_any_result() -> None:
    async def feedback_of(goal_id: GoalID) -> int:
        with await server.feedback(goal_id, after=0) as stream:
            return sum([isinstance(update, FeedbackItem) async for update in stream])

    async def one_that_ends() -> GoalID:
        goal_id = GoalID.random()
        with await server.send_goal(goal_id, packed(4), feedback=False) as stream:
            await stream.outcome()
        return goal_id

    async with ActionServer(FIBONACCI, fibonacci, result_timeout=5) as server:
        goals = [await one_that_ends() for _ in range(3)]
        await anyio.sleep(4)
        last = await one_that_ends()
        assert [await feedback_of(one) for one in goals] == [3, 3, 3]
        await anyio.sleep(1 + EXPIRY_STEP)
        with pytest.raises(UnknownGoal):
            await feedback_of(goals[0])
        kept, budget = await one_that_ends(), server._parts.runs._registry.budget
        budget.limit = budget.used + 20  # so the next goal takes the place of the oldest feedback
        new = await one_that_ends()
        assert [await feedback_of(one) for one in (last, kept, new)] == [0, 3, 3]
        await server.get_result(last)


@pytest.mark.promise("FEEDBACK-11")
@in_virtual_time()
@pytest.mark.parametrize("are_watched", [False, True], ids=["", "watched"])
async def test_feedback_of_ended_goals_gives_way_before_that_of_an_active_one(
    are_watched: bool,
) -> None:
    async def counts(goal: GoalHandle[Goal]) -> Items:
        for number in range(8):
            yield Feedback([number] * 1000)
        begun.append(anyio.current_time())
        if goal.request.order:
            await anyio.sleep_forever()
        yield Result([])

    begun: list[float] = []
    async with ActionServer(FIBONACCI, counts, feedback_window=9, max_bytes=10_000) as server:
        statuses = await server.status() if are_watched else None
        await (await server.send_goal(GoalID.random(), packed(0), feedback=False)).outcome()
        assert budget_of(server).used > 8000
        stream = await server.send_goal(GoalID.random(), packed(1))  # its client reads nothing yet
        await anyio.wait_all_tasks_blocked()
        assert begun == [begun[0]] * 2, "the executor waited"
        with anyio.fail_after(1):
            items = [await stream.receive() for _ in range(8)]
        assert [item.number for item in items if isinstance(item, FeedbackItem)] == [*range(1, 9)]
        assert (statuses is not None) is are_watched


@pytest.mark.promise("FEEDBACK-4")
@in_virtual_time()
async def test_a_client_that_stalls_holds_the_executor_up_for_its_time_once() -> None:
    times = []

    async def counts(goal: GoalHandle[Goal]) -> Items:
        for number in range(10):
            yield Feedback([number])
            times.append(anyio.current_time() - start)
        yield Result([])

    async with ActionServer(FIBONACCI, counts, feedback_window=3, stall_timeout=10) as server:
        start = anyio.current_time()
        stream = await server.send_goal(GoalID.random(), packed(1))
        await stream.outcome()
    assert times == pytest.approx([0, 0] + [10] * 8)


# Limits for all clients together


@pytest.mark.promise("ACCEPT-14")
async def test_a_goal_too_many_is_rejected_until_another_one_has_ended() -> None:
    executor = Held()
    async with ActionServer(FIBONACCI, executor, max_goals=2) as server:
        streams = await start_many(server, 2)
        goal_id = GoalID.random()
        for _ in range(2):
            with pytest.raises(GoalRejected) as caught:
                await server.send_goal(goal_id, packed(3))
            assert caught.value.reason == "busy: 2 goals are active, the limit is 2"
            assert caught.value.goal_id == goal_id
        again = await server.send_goal(streams[0].goal_id, packed(0))  # a retry is not a new goal
        await server.cancel_goals(streams[1].goal_id)
        await streams[1].outcome()
        stream = await server.send_goal(goal_id, packed(3))
        executor.go.set()
        assert (await stream.outcome()).result == result([3])
        assert (await again.outcome()).result == result([0])


@pytest.mark.promise("ACCEPT-14")
async def test_goals_that_are_being_decided_count() -> None:
    gate = Gate()
    async with ActionServer(FIBONACCI, fibonacci, on_goal=gate, max_goals=1) as server:
        asking = waited_for(server.offer_goal(GoalRequest(GoalID.random(), packed(2))))
        with pytest.raises(GoalRejected, match="busy: 1 goals are active, the limit is 1"):
            server.offer_goal(GoalRequest(GoalID.random(), packed(2)))
        gate.open.set()
        assert gate.asked == []
        assert (await (await asking).outcome()).status is GoalStatus.SUCCEEDED


def budget_of(server: ActionServer[Any, Any, Any]) -> ByteBudget:
    return server._parts.runs._registry.budget


async def test_as_many_results_are_forgotten_for_a_goal_as_it_needs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(goal_logs, "FORGOTTEN_AT_ONCE", 1)
    async with ActionServer(FIBONACCI, fibonacci, max_bytes=200) as server:
        for _ in range(20):
            await (await server.send_goal(GoalID.random(), packed(1))).outcome()
        with await server.status() as statuses:
            assert 4 < statuses.known < 20
        held = budget_of(server)
        held.take(150)  # a large goal, say
        stream = await server.send_goal(GoalID.random(), packed(1))
        assert (await stream.outcome()).status is GoalStatus.SUCCEEDED
        with await server.status() as statuses:
            assert statuses.known < 4
        held.give_back(150)


@pytest.mark.promise("ACCEPT-14", "RESULT-9")
async def test_results_give_way_to_goals_and_goals_to_nothing() -> None:
    executor = Held()
    executor.go.set()
    size = len(packed(1))
    async with ActionServer(FIBONACCI, executor, max_bytes=3 * size) as server:
        old = await server.send_goal(GoalID.random(), packed(1))
        await old.outcome()
        old_id = old.goal_id
        assert (await server.get_result(old_id)).status is GoalStatus.SUCCEEDED
        del old
        executor.go = anyio.Event()
        with await server.status() as statuses:
            await statuses.receive()
            held = await start_many(server, 3)
            assert (await server.get_result(old_id)).status is GoalStatus.UNKNOWN
            told = [info async for info in several(statuses, 4)]
            assert [info.goal_id for info in told if not info.status.is_active] == [old_id]
        used = budget_of(server).used
        with pytest.raises(GoalRejected) as caught:
            await server.send_goal(GoalID.random(), packed(4))
        assert caught.value.reason == (
            f"busy: goals and feedback would take {used + size} bytes, the limit is {3 * size}"
        )
        assert budget_of(server).used == used
        budget_of(server).limit = 1000  # the results are larger than their goals
        executor.go.set()
        assert {(await stream.outcome()).status for stream in held} == {GoalStatus.SUCCEEDED}


@pytest.mark.promise("RESULT-9")
async def test_a_client_that_leaves_results_unread_sends_no_more_goals_and_others_do() -> None:
    async def large(goal: GoalHandle[Goal]) -> Items:
        yield Result([0] * 1000)

    async with ActionServer(FIBONACCI, large, max_bytes=3500, result_timeout=0) as server:

        async def sent_by(name: str) -> GoalStream:
            sender = Sender(owner=name.encode())
            stream = await server.send_goal(GoalID.random(), packed(1), sender=sender)
            assert (await stream.outcome()).status is GoalStatus.SUCCEEDED
            return stream

        kept = [await sent_by("ann") for _ in range(2)]
        with pytest.raises(GoalRejected, match="busy: its client has not read results of"):
            await sent_by("ann")
        await sent_by("bob")
        kept.clear()
        await sent_by("ann")


async def several(statuses: StatusStream, count: int) -> AsyncIterator[GoalInfo]:
    """The next statuses, those of goals that are new or forgotten."""
    while count:
        info = await statuses.receive()
        assert info is not None
        if info.status in (GoalStatus.ACCEPTED, GoalStatus.UNKNOWN):
            count -= 1
            yield info


@pytest.mark.parametrize("result_timeout", [0, 0.01])
@given(
    steps=strategies.lists(
        strategies.tuples(
            strategies.sampled_from(["send", "follow", "statuses", "read", "close", "cancel"]),
            strategies.integers(0, 5),
        ),
        max_size=40,
    ),
    max_bytes=strategies.sampled_from([0, 30, 200, 10_000]),
)
@settings(max_examples=min(30, settings().max_examples), deadline=None)
def test_when_all_has_ended_and_is_forgotten_no_bytes_are_counted(
    steps: list[tuple[str, int]], max_bytes: int, result_timeout: float
) -> None:
    async def check() -> None:
        async def executor(goal: GoalHandle[Goal]) -> Items:
            for number in range(goal.request.order):
                yield Feedback([number] * number)
                await anyio.lowlevel.checkpoint()
            yield Result([goal.request.order] * 5)

        server = ActionServer(
            FIBONACCI,
            executor,
            max_bytes=max_bytes,
            max_results=2,
            result_timeout=result_timeout,
            stall_timeout=0,
        )
        streams: list[Any] = []

        async def use(stream: Any, step: str) -> None:
            if step == "close":
                stream.close()
            elif isinstance(stream, GoalStream):
                if step == "follow":
                    streams.append(await server.feedback(stream.goal_id, after=0))
                else:
                    stream.take(2)

        async with server:
            for step, number in steps:
                with suppress(GoalRejected, UnknownGoal):
                    if step == "send":
                        sending = server.send_goal(GoalID.random(), packed(number))
                        streams.append(await sending)
                    elif step == "statuses":
                        streams.append(await server.status())
                    elif step == "cancel":
                        await server.cancel_goals()
                    elif number < len(streams):
                        await use(streams[number], step)
                await anyio.lowlevel.checkpoint()
            await anyio.wait_all_tasks_blocked()
        assert not server._parts.runs._runs
        while streams:
            streams.pop().close()
        budget = budget_of(server)
        while server._parts.logs.expire(math.inf):
            pass
        gc.collect()
        assert budget.used == 0

    anyio.run(check)


# Many goals


async def test_memory_does_not_grow_beyond_the_kept_results() -> None:
    async with ActionServer(FIBONACCI, fibonacci, max_results=100) as server:

        async def run_goals(count: int) -> None:
            for _ in range(count):
                await (await server.send_goal(GoalID.random(), packed(2))).outcome()

        await run_goals(300)
        gc.collect()
        tracemalloc.start()
        try:
            before, _ = tracemalloc.get_traced_memory()
            await run_goals(1500)
            gc.collect()
            after, _ = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    # The hundred kept goals were made before tracing began, and are replaced by traced ones: some
    # 2,300 bytes each, 1,600 of them for feedback. If each of the 1,500 left only 40 bytes behind,
    # it would be 60,000 more.
    assert after - before < 290_000

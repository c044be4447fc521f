"""`fibaction.server.admission`: the decision on a goal, beyond what the contract suite shows."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator, Coroutine
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import (
    Action,
    ActionServer,
    CancelCode,
    GoalHandle,
    GoalID,
    GoalRejected,
    GoalStatus,
    Outcome,
    RejectionCode,
    ServerNotFound,
)
from fibaction.border.abc import GoalRequest, GoalStream
from fibaction.words.goals import Sender
from tests.server.held import Held, packed, result
from tests.support.executors import Items
from tests.support.fibonacci import FIBONACCI, Goal, Result, fibonacci
from tests.support.matching import End

ARM, LEG = Sender("the arm"), Sender("the leg")

pytestmark = pytest.mark.anyio


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


# Deciding


async def test_a_goal_that_was_not_decided_because_python_ends_is_decided_anew() -> None:
    asked = []

    def on_goal(goal: Goal) -> None:
        asked.append(goal)
        if len(asked) == 1:
            raise KeyboardInterrupt

    async with ActionServer(FIBONACCI, fibonacci, on_goal=on_goal) as server:
        goal_id = GoalID.random()
        with pytest.raises(KeyboardInterrupt):
            await server.send_goal(goal_id, packed(1))
        with anyio.fail_after(5):
            stream = await server.send_goal(goal_id, packed(1))
            assert (await stream.outcome()).status is GoalStatus.SUCCEEDED
    assert len(asked) == 2


def at_once(
    offered: GoalStream | Coroutine[Any, Any, GoalStream],
) -> GoalStream:
    """Return the stream of a goal that was decided at once."""
    assert isinstance(offered, GoalStream)
    return offered


def waited_for(
    offered: GoalStream | Coroutine[Any, Any, GoalStream],
) -> Coroutine[Any, Any, GoalStream]:
    """Return the coroutine that waits for the decision on a goal."""
    assert not isinstance(offered, GoalStream)
    return offered


def agree(goal: Goal) -> None:
    """A callback that has nothing against it."""


async def agree_later(goal: Goal) -> None:
    await anyio.lowlevel.checkpoint()


# Offering a goal


@pytest.mark.parametrize("on_goal", [None, agree], ids=["no on_goal", "a sync one"])
async def test_a_goal_that_needs_no_wait_is_accepted_at_once(on_goal: Any) -> None:
    async with ActionServer(FIBONACCI, fibonacci, on_goal=on_goal) as server:
        goal_id = GoalID.random()
        stream = at_once(server.offer_goal(GoalRequest(goal_id, packed(2))))
        assert (stream.goal_id, stream.status) == (goal_id, GoalStatus.ACCEPTED)
        item = await stream.receive()
        assert item is not None
        assert item.number == 1
        assert await stream.receive() is None
        assert await stream.outcome() == End(GoalStatus.SUCCEEDED, result([0, 1, 1]))


async def test_a_goal_is_offered_with_or_without_its_feedback() -> None:
    async with ActionServer(FIBONACCI, fibonacci, on_goal=agree) as server:
        goal_id = GoalID.random()
        without = at_once(server.offer_goal(GoalRequest(goal_id, packed(2), feedback=False)))
        again = at_once(server.offer_goal(GoalRequest(goal_id, packed(2), feedback=False)))
        outcome = await without.outcome()
        assert outcome.status is GoalStatus.SUCCEEDED
        assert without.take() == again.take() == (outcome,)


@pytest.mark.parametrize(
    "on_goal", [agree_later, lambda goal: agree_later(goal)], ids=["async", "gives an awaitable"]
)
async def test_only_a_callback_that_takes_its_time_is_waited_for(on_goal: Any) -> None:
    async with ActionServer(FIBONACCI, fibonacci, on_goal=on_goal) as server:
        goal_id = GoalID.random()
        asking = waited_for(server.offer_goal(GoalRequest(goal_id, packed(2))))
        assert repr(server).endswith("goals=0>")
        stream = await asking
        assert stream.goal_id == goal_id
        assert (await stream.outcome()).status is GoalStatus.SUCCEEDED


async def test_a_goal_that_cannot_be_is_rejected_at_once_and_again() -> None:
    def refuse(goal: Goal) -> None:
        raise GoalRejected("never")

    async with ActionServer(FIBONACCI, fibonacci, on_goal=refuse) as server:
        for payload, reason in (
            (b"\x01", "goal must be a map of fields, not 1"),
            (packed(1), "never$"),
        ):
            goal_id = GoalID.random()
            for _ in range(2):
                with pytest.raises(GoalRejected, match=reason) as caught:
                    server.offer_goal(GoalRequest(goal_id, payload))
                assert caught.value.goal_id == goal_id
                assert (caught.value.code is RejectionCode.UNREADABLE) == (payload == b"\x01")
    with pytest.raises(ServerNotFound, match="'fibonacci' is not running"):
        server.offer_goal(GoalRequest(GoalID.random(), packed(1)))


async def test_a_large_goal_that_is_checked_in_a_thread_is_decided_afterwards() -> None:
    asked: list[int] = []

    def decide(goal: Words) -> None:
        asked.append(len(goal.words))

    async def decide_later(goal: Words) -> None:
        await anyio.lowlevel.checkpoint()
        decide(goal)

    async def count(goal: GoalHandle[Words]) -> AsyncGenerator[Any, None]:
        yield len(goal.request.words)

    action = Action("count", goal=Words, feedback=str, result=int)
    payload = msgspec.msgpack.encode({"words": ["word" * 20] * 50})
    for on_goal in (decide, decide_later, None):
        async with ActionServer(action, count, on_goal=on_goal) as server:
            offered = server.offer_goal(GoalRequest(GoalID.random(), payload))
            stream = await waited_for(offered)
            assert (await stream.outcome()).status is GoalStatus.SUCCEEDED
    assert asked == [50, 50]


class Words(msgspec.Struct):
    words: list[str]


async def test_a_goal_that_is_rejected_after_a_while_is_rejected_by_what_was_waited_for() -> None:
    async def refuse(goal: Goal) -> None:
        await anyio.lowlevel.checkpoint()
        raise GoalRejected("not today")

    async with ActionServer(FIBONACCI, fibonacci, on_goal=refuse) as server:
        goal_id = GoalID.random()
        asking = waited_for(server.offer_goal(GoalRequest(goal_id, packed(1))))
        with pytest.raises(GoalRejected, match="not today") as caught:
            await asking
        assert caught.value.goal_id == goal_id
        # It is remembered, so that the next one need not wait.
        with pytest.raises(GoalRejected, match="not today"):
            server.offer_goal(GoalRequest(goal_id, packed(1)))


async def test_a_goal_that_is_offered_again_is_there_at_once_with_its_first_feedback() -> None:
    async with ActionServer(FIBONACCI, fibonacci) as server:
        goal_id = GoalID.random()
        first = at_once(server.offer_goal(GoalRequest(goal_id, packed(4))))
        again = at_once(server.offer_goal(GoalRequest(goal_id, packed(4))))
        assert again.stamp == first.stamp
        await first.outcome()
        late = at_once(server.offer_goal(GoalRequest(goal_id, packed(4))))
        for stream in (again, late):
            numbers = []
            while (item := await stream.receive()) is not None:
                numbers.append(item.number)
            assert numbers == [1, 2, 3]


class Gate:
    """An `on_goal` that decides when it is told to."""

    def __init__(self) -> None:
        self.asked: list[Goal] = []
        self.open = anyio.Event()

    async def __call__(self, goal: Goal) -> None:
        self.asked.append(goal)
        await self.open.wait()


@pytest.mark.parametrize("late", [False, True], ids=["before", "after"])
async def test_a_goal_that_is_being_decided_waits_for_that_decision(late: bool) -> None:
    gate = Gate()
    async with ActionServer(FIBONACCI, fibonacci, on_goal=gate) as server:
        goal_id = GoalID.random()
        stamps: list[int] = []

        async def wait(asking: Coroutine[Any, Any, GoalStream]) -> None:
            stamps.append((await asking).stamp)

        with anyio.fail_after(5):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(
                    wait, waited_for(server.offer_goal(GoalRequest(goal_id, packed(2))))
                )
                await anyio.wait_all_tasks_blocked()
                again = waited_for(server.offer_goal(GoalRequest(goal_id, packed(2))))
                if late:  # the decision is there before anybody waits for it
                    gate.open.set()
                    await anyio.wait_all_tasks_blocked()
                    assert len(stamps) == 1
                tasks.start_soon(wait, again)
                await anyio.wait_all_tasks_blocked()
                assert len(stamps) == (2 if late else 0)
                gate.open.set()
        assert len(set(stamps)) == 1
    assert gate.asked == [Goal(2)]


async def test_a_goal_that_is_canceled_while_it_waits_can_be_sent_anew() -> None:
    gate = Gate()
    async with ActionServer(FIBONACCI, fibonacci, on_goal=gate) as server:
        goal_id = GoalID.random()
        asking = waited_for(server.offer_goal(GoalRequest(goal_id, packed(2))))

        async def wait() -> None:
            await asking

        with anyio.fail_after(5):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(wait)
                await anyio.wait_all_tasks_blocked()
                tasks.cancel_scope.cancel()
            assert (await server.cancel_goals(goal_id)).return_code is CancelCode.UNKNOWN_GOAL_ID
            gate.open.set()
            # Another goal even, with the same ID: nothing is left of the first.
            stream = await waited_for(server.offer_goal(GoalRequest(goal_id, packed(3))))
            assert (await stream.outcome()).result == result([0, 1, 1, 2])
    assert gate.asked == [Goal(2), Goal(3)]


async def test_a_goal_whose_decision_is_not_awaited_yet_is_rejected_by_the_stop() -> None:
    async with ActionServer(FIBONACCI, fibonacci, on_goal=Gate()) as server:
        asking = waited_for(server.offer_goal(GoalRequest(GoalID.random(), packed(2))))
        await server.stop()
    with anyio.fail_after(5):
        with pytest.raises(GoalRejected, match="the server is stopping"):
            await asking


async def test_a_decision_that_does_not_end_with_the_server_comes_too_late() -> None:
    asked, go = anyio.Event(), anyio.Event()
    codes: list[RejectionCode] = []

    async def on_goal(goal: Goal) -> None:
        asked.set()
        with anyio.CancelScope(shield=True):
            await go.wait()

    async def send() -> None:
        with pytest.raises(GoalRejected) as caught:
            await waited_for(server.offer_goal(GoalRequest(GoalID.random(), packed(1))))
        codes.append(caught.value.code)

    async with ActionServer(FIBONACCI, fibonacci, on_goal=on_goal) as server:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(send)
            await asked.wait()
            tasks.start_soon(server.stop)
            await anyio.wait_all_tasks_blocked()
            go.set()
    assert codes == [RejectionCode.STOPPING]


@pytest.mark.promise("ACCEPT-6")
async def test_a_goal_that_runs_is_followed_when_it_is_sent_again_while_the_server_stops() -> None:
    begun, cleaning, go = anyio.Event(), anyio.Event(), anyio.Event()

    async def executor(goal: GoalHandle[Goal]) -> Items:
        begun.set()
        try:
            await anyio.sleep_forever()
        finally:
            cleaning.set()
            with anyio.CancelScope(shield=True):
                await go.wait()
        yield Result([])  # never: it is interrupted

    async with ActionServer(FIBONACCI, executor) as server:
        request = GoalRequest(GoalID.random(), packed(1))
        stream = at_once(server.offer_goal(request))
        await begun.wait()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(server.stop)
            await cleaning.wait()
            again = at_once(server.offer_goal(request))
            assert again.stamp == stream.stamp
            with pytest.raises(GoalRejected) as caught:
                server.offer_goal(GoalRequest(GoalID.random(), packed(1)))
            assert caught.value.code is RejectionCode.STOPPING
            go.set()
        assert (await again.outcome()).status is GoalStatus.ABORTED


async def test_the_sender_of_a_goal_is_told_with_each_of_its_statuses() -> None:
    gate = Gate()
    async with ActionServer(FIBONACCI, fibonacci, on_goal=gate) as server:
        with await server.status() as statuses:
            assert statuses.known == 0
            goal_id = GoalID.random()
            gate.open.set()
            stream = await waited_for(
                server.offer_goal(GoalRequest(goal_id, packed(2), sender=ARM))
            )
            # A client that sends it again is not its sender.
            again = at_once(server.offer_goal(GoalRequest(goal_id, packed(2), sender=LEG)))
            assert again.stamp == stream.stamp
            await stream.outcome()
            told = [await statuses.receive() for _ in range(3)]
        assert [info.client for info in told if info is not None] == ["the arm"] * 3
        with await server.status() as statuses:
            assert statuses.known == 1


@pytest.mark.promise("DEADLINE-4")
async def test_the_executor_gets_the_first_deadline_of_its_goal() -> None:
    deadlines: list[float] = []

    async def executor(goal: GoalHandle[Goal]) -> Items:
        deadlines.append(goal.deadline)
        with anyio.CancelScope(deadline=goal.deadline - 1) as scope:
            await anyio.lowlevel.checkpoint()
        assert not scope.cancelled_caught
        yield Result([])

    async with ActionServer(FIBONACCI, executor) as server:
        goal_id, before = GoalID.random(), anyio.current_time()
        stream = await server.send_goal(goal_id, packed(1), timeout=100)
        await server.send_goal(goal_id, packed(1), timeout=1000)
        await stream.outcome()
        await (await server.send_goal(GoalID.random(), packed(1))).outcome()
    assert before + 100 <= deadlines[0] <= before + 200
    assert deadlines[1:] == [math.inf]


@pytest.mark.promise("FEEDBACK-13")
async def test_a_goal_sent_again_is_the_senders_own_only_if_it_was_the_first_to_send_it() -> None:
    executor = Held()
    async with ActionServer(FIBONACCI, executor) as server:

        def offer(owner: bytes, feedback: bool = True) -> Any:
            sender = Sender("the arm", owner)
            return at_once(
                server.offer_goal(GoalRequest(goal_id, packed(2), feedback=feedback, sender=sender))
            )

        goal_id = GoalID.random()
        streams = [offer(b"arm"), offer(b"arm"), offer(b"arm", False), offer(b"leg"), offer(b"")]
        assert [stream.own for stream in streams] == [True, True, True, False, False]
        assert [stream.holding for stream in streams] == [True, True, False, False, False]
        assert [(await server.feedback(goal_id, own=own)).own for own in (True, False)] == [
            True,
            False,
        ]
        assert server.owner_of(goal_id) == b"arm"
        assert server.owner_of(GoalID.random()) == b""
        executor.go.set()


async def test_a_caller_that_waited_for_the_decision_and_then_decides_is_the_sender() -> None:
    gate = Gate()
    async with ActionServer(FIBONACCI, fibonacci, on_goal=gate) as server:
        goal_id = GoalID.random()
        first = waited_for(server.offer_goal(GoalRequest(goal_id, packed(2), sender=ARM)))
        scope = anyio.CancelScope()
        streams: list[GoalStream] = []

        async def give_up() -> None:
            with scope:
                await first

        async def wait(asking: Coroutine[Any, Any, GoalStream]) -> None:
            streams.append(await asking)

        with anyio.fail_after(5):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(give_up)
                await anyio.wait_all_tasks_blocked()
                again = server.offer_goal(
                    GoalRequest(goal_id, packed(2), feedback=False, sender=LEG)
                )
                tasks.start_soon(wait, waited_for(again))
                await anyio.wait_all_tasks_blocked()
                scope.cancel()
                await anyio.wait_all_tasks_blocked()
                gate.open.set()
            assert [type(one) async for one in streams[0]] == [Outcome]  # as it was asked for
            with await server.status() as statuses:
                info = await statuses.receive()
            assert info is not None
            assert info.client == "the leg"


@pytest.mark.parametrize("followed", [True, False])
async def test_a_follower_that_comes_after_the_end_gets_the_feedback_that_another_has_kept(
    followed: bool,
) -> None:
    async with ActionServer(FIBONACCI, fibonacci) as server:
        stream = at_once(
            server.offer_goal(GoalRequest(GoalID.random(), packed(4), feedback=followed))
        )
        goal_id = stream.goal_id
        await stream.outcome()
        late = await server.feedback(stream.goal_id, after=0)
        numbers = []
        while (item := await late.receive()) is not None:
            numbers.append(item.number)
        assert (numbers, late.dropped) == ([1, 2, 3], 0)
        assert await late.outcome() == await stream.outcome()
        del stream, late
        await anyio.wait_all_tasks_blocked()
        later = await server.feedback(goal_id, after=0)
        assert (await later.receive(), later.dropped) == (None, 3)

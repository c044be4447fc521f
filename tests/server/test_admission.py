"""`fibaction.server.admission`: the decision on a goal, beyond what the contract suite shows."""

from __future__ import annotations

from collections.abc import Coroutine
from typing import Any

import anyio
import pytest

from fibaction import (
    ActionServer,
    GoalHandle,
    GoalID,
    GoalRejected,
    GoalStatus,
    RejectionCode,
)
from fibaction.border.abc import GoalRequest, GoalStream
from fibaction.words.goals import Sender
from tests.server.held import Held, packed, waited_for
from tests.support.executors import Items
from tests.support.fibonacci import FIBONACCI, Goal, Result, fibonacci

ARM, LEG = Sender("the arm"), Sender("the leg")

pytestmark = pytest.mark.anyio


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


# Offering a goal


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

"""The goals that a server of A2A follows, when servers fail."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import Any, cast

import anyio
import pytest
from a2a.utils.errors import InternalError

from fibaction import ActionClient, serve
from fibaction.border.abc import ForwardingEndpoint, GoalRequest, GoalStream
from fibaction.border.gateway import group_of
from fibaction.words.errors import ConnectionLost, LimitReached
from fibaction.words.goals import CancelAnswer, CancelCode, GoalID
from fibaction_transports._agents import agent_goals
from fibaction_transports.a2a import A2aHttpTransport
from tests.support.processes import PATIENCE
from tests.transports.a2a.agent_talk import TOKEN, Robot, Talk, data_of, state_of, talking, told
from tests.transports.driving_robot import DRIVE, Drive

pytestmark = pytest.mark.asyncio


class Failing(ForwardingEndpoint):
    """An endpoint whose answers get lost when a test wants it."""

    fails = False
    stream: GoalStream
    was_own: bool

    async def offer_goal(self, request: GoalRequest) -> GoalStream:
        if self.fails:
            raise ConnectionLost("the line is down")
        self.stream = await super().offer_goal(request)
        return self.stream

    async def feedback(
        self,
        goal_id: GoalID,
        *,
        after: int | None = None,
        own: bool = False,
        attempt: int = 1,
    ) -> GoalStream:
        if self.fails:
            raise LimitReached("too many follow it")
        self.was_own = own
        return await super().feedback(goal_id, after=after, own=own, attempt=attempt)

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        raise ConnectionLost("the line is down")


@asynccontextmanager
async def failing() -> AsyncGenerator[tuple[Robot, Failing, Talk], None]:
    robot = Robot()
    endpoint = Failing(robot.drive)
    transport = A2aHttpTransport(port=0, token=TOKEN, unasked="*")
    async with (
        serve(robot.drive, robot.here),
        serve(endpoint, transport) as (url,),
        talking(url) as talk,
    ):
        yield robot, endpoint, talk


async def test_a_goal_whose_answer_is_lost_may_have_been_sent() -> None:
    async with failing() as (_, endpoint, talk):
        endpoint.fails = True
        with pytest.raises(InternalError, match="may not have been sent: the line is down"):
            await talk.send({"meters": 3})


async def test_a_cancel_whose_answer_is_lost_says_so() -> None:
    async with failing() as (robot, _, talk):
        task = await talk.send({"meters": 100}, at_once=True)
        with pytest.raises(InternalError, match="the goal may continue: the line is down"):
            await talk.cancel(task.id)
        robot.go(100)


async def test_a_goal_that_is_lost_is_followed_again() -> None:
    async with failing() as (robot, endpoint, talk):
        updates = talk.stream({"meters": 100})
        task_id = (await anext(updates)).task.id
        robot.go(2)
        while told(await anext(updates)) != "2: {'meters': 2.0}":
            pass
        endpoint.stream.fail(ConnectionLost("the line is down"))
        with pytest.raises(InternalError, match="line is down; subscribe again"):
            await anext(updates)
        endpoint.fails = True
        with pytest.raises(InternalError, match="cannot be followed now: too many follow it"):
            await talk.get(task_id)
        endpoint.fails = False
        again = talk.subscribe(task_id, "1")
        assert [told(await anext(again)) for _ in "ab"] == ["task WORKING", "2: {'meters': 2.0}"]
        assert endpoint.was_own
        robot.go(98)
        assert [told(update) async for update in again][-1] == "COMPLETED"


async def test_only_so_many_goals_are_followed_and_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agent_goals, "MOST_ACTIVE", 1)
    monkeypatch.setattr(agent_goals, "MOST_ENDED", 1)
    async with failing() as (robot, endpoint, talk):
        running = await talk.send({"meters": 100}, at_once=True)
        with pytest.raises(InternalError, match="1 goals are active here already"):
            await talk.send({"meters": 3})
        robot.go(100)
        with anyio.fail_after(PATIENCE):
            while state_of(await talk.get(running.id)) != "COMPLETED":
                pass
        for _ in range(3):
            last = await talk.send({"meters": 3})
        assert state_of(await talk.get(last.id)) == "COMPLETED"
        # It is no longer kept here, so its server is asked.
        again = await talk.get(running.id)
        assert (state_of(again), data_of(again.artifacts[0].parts)) == ("COMPLETED", {"at": 100})
        assert not endpoint.was_own


async def test_a_task_is_not_unknown_while_a_server_is_away() -> None:
    robot = Robot()
    group = group_of([robot.drive])
    group.problems["two"] = "the line is down"
    transport = A2aHttpTransport(port=0, token=TOKEN)
    async with (
        serve(robot.drive, robot.here),
        transport.serve_group(group) as gateway,
        talking(gateway.url) as talk,
    ):
        with pytest.raises(InternalError, match="cannot be reached now: ask again"):
            await talk.get(str(GoalID.random()))


async def test_the_newest_feedback_of_a_goal_of_others_is_known_at_once() -> None:
    robot = Robot()
    async with serve(robot.drive, robot.here):
        goal = await ActionClient(robot.drive, DRIVE).send_goal(Drive(100))
        robot.go(2)
        with anyio.fail_after(PATIENCE):
            assert (await anext(goal.feedback)).meters == 1
            assert (await anext(goal.feedback)).meters == 2
        transport = A2aHttpTransport(port=0, token=TOKEN)
        async with serve(robot.drive, transport) as (url,), talking(url) as talk:
            task = await talk.get(str(goal.goal_id))
            assert data_of(task.status.message.parts) == {"meters": 2}
        robot.go(98)


@pytest.mark.parametrize("is_known", [False, True])
async def test_a_goal_whose_agent_stops_waiting_while_it_is_sent_first_is_canceled(
    is_known: bool,
) -> None:
    class Undecided:
        canceled: GoalID | None = None

        async def send_goal(self, *_: object) -> None:
            scope.cancel()
            await anyio.sleep_forever()

        async def cancel_goals(self, goal_id: GoalID) -> CancelAnswer:
            self.canceled = goal_id
            return CancelAnswer(CancelCode.NONE)

    skill, goal_id = SimpleNamespace(endpoint=Undecided()), GoalID.random()
    goals: Any = agent_goals.AgentGoals(cast("Any", None))
    if is_known:  # from an earlier request
        goals._goals[goal_id] = SimpleNamespace(ended=anyio.Event())
    with anyio.CancelScope() as scope:
        await goals.send(skill, goal_id, b"", owner="")
    assert skill.endpoint.canceled == (None if is_known else goal_id)

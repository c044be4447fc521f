"""Goals that an executor sends as steps of its own: their IDs, their cancels, and planned stops."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from pathlib import Path
from typing import TypeAlias

import anyio
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalHandle,
    GoalInfo,
    GoalStatus,
    Parent,
    SqliteStore,
)
from fibaction.testing.contract.executors import Steps
from fibaction.testing.contract.fibonacci import FIBONACCI, Feedback, Goal, Result
from fibaction.testing.contract.matching import End
from fibaction.testing.contract.reach import Reach
from fibaction.testing.contract.test_senders import Metas
from fibaction.words.goals import child_id

pytestmark = pytest.mark.anyio

MISSION = Action("mission", goal=int, feedback=int, result=list[int])
Items: TypeAlias = AsyncGenerator[int | list[int], None]
Arm: TypeAlias = ActionClient[Goal, Feedback, Result]


class Mission:
    """The executor of a parent with one step."""

    def __init__(self, arm: Arm, *, wait_for_end: bool = False) -> None:
        self._arm, self._wait_for_end = arm, wait_for_end
        self.kept: list[bool] = []
        """Whether the goal was kept, for each interruption."""

    async def __call__(self, goal: GoalHandle[int]) -> Items:
        step = goal.step("pick", wait_for_end=self._wait_for_end)
        try:
            async with self._arm.send_goal(Goal(goal.request), step=step) as picking:
                async for _ in picking.feedback:
                    yield goal.attempt
                result = await picking.result()
        except anyio.get_cancelled_exc_class():
            self.kept.append(goal.is_kept)
            raise
        yield result.sequence


@pytest.mark.promise("CHILD-1", "CHILD-2")
async def test_a_cancel_of_a_parent_reaches_its_child_and_waits_for_its_end(reach: Reach) -> None:
    child = Steps()
    child.clean = anyio.Event()
    async with reach(ActionServer(FIBONACCI, child)) as arm:
        mission = Mission(arm, wait_for_end=True)
        async with ActionServer(MISSION, mission) as server:
            goal = await ActionClient(server, MISSION).send_goal(7)
            await child.began.wait()
            expected = child_id(goal.goal_id, "fibonacci", "pick")
            follower = await arm.attach(expected)
            assert (await goal.cancel()).accepted
            while follower.status is not GoalStatus.CANCELING:
                await follower.feedback.stream.news.wait()
                follower.feedback.stream.take()
            assert goal.status is not GoalStatus.CANCELED
            child.clean.set()
            assert (await goal.outcome()).status is GoalStatus.CANCELED
            assert (await follower.outcome()).status is GoalStatus.CANCELED

    assert child.runs == {expected: 1}
    assert mission.kept == [False]


@pytest.mark.promise("CHILD-1", "CHILD-3")
async def test_a_planned_stop_leaves_a_child_and_the_next_attempt_follows_it(
    reach: Reach, tmp_path: Path
) -> None:
    child, store = Steps(), SqliteStore(tmp_path / "goals.db", sync="normal")
    async with reach(ActionServer(FIBONACCI, child)) as arm:
        mission = Mission(arm)
        async with ActionServer(MISSION, mission, store=store, at_stop="keep") as server:
            goal = await ActionClient(server, MISSION).send_goal(7)
            await child.began.wait()
            await anext(goal.feedback)  # the child is accepted
        assert mission.kept == [True]
        async with ActionServer(MISSION, mission, store=store, at_stop="keep") as server:
            again = await ActionClient(server, MISSION).attach(goal.goal_id)
            child.go.set()
            assert await again.outcome() == End(GoalStatus.SUCCEEDED, [7])
            assert again.attempt == 2

    assert child.runs == {child_id(goal.goal_id, "fibonacci", "pick"): 1}


@pytest.mark.promise("CHILD-1")
async def test_a_child_that_ended_before_the_next_attempt_is_not_sent_again(
    reach: Reach, tmp_path: Path
) -> None:
    child, store = Steps(), SqliteStore(tmp_path / "goals.db", sync="normal")
    child.go.set()
    between = anyio.Event()

    async def mission(goal: GoalHandle[int]) -> Items:
        result = await arm.call(Goal(goal.request), step=goal.step("pick"))
        yield goal.attempt
        await between.wait()
        yield result.sequence

    async with reach(ActionServer(FIBONACCI, child)) as arm:
        async with ActionServer(MISSION, mission, store=store, at_stop="keep") as server:
            goal = await ActionClient(server, MISSION).send_goal(7)
            await anext(goal.feedback)
        between.set()
        async with ActionServer(MISSION, mission, store=store, at_stop="keep") as server:
            again = await ActionClient(server, MISSION).attach(goal.goal_id)
            assert await again.result() == [7]

    assert child.runs.total() == 1


@pytest.mark.promise("ACCEPT-16")
async def test_the_meta_of_a_child_names_its_parent(reach: Reach) -> None:
    child, metas = Steps(go=True), Metas()
    async with reach(ActionServer(FIBONACCI, child, watchers=[metas])) as arm:
        async with ActionServer(MISSION, Mission(arm)) as server:
            goal = await ActionClient(server, MISSION).send_goal(7)
            assert await goal.result() == [7]

    assert [meta["parent"] for meta in metas.noted] == [str(goal.goal_id)]


@pytest.mark.promise("CHILD-4")
async def test_lists_and_followers_are_told_the_parent_of_a_child_also_after_its_end(
    reach: Reach,
) -> None:
    child = Steps()
    async with reach(ActionServer(FIBONACCI, child)) as arm, arm.events() as events:
        own = await arm.send_goal(Goal(1))
        async with ActionServer(MISSION, Mission(arm)) as server:
            goal = await ActionClient(server, MISSION).send_goal(7)
            told = Parent(goal.goal_id, "pick")
            expected = child_id(goal.goal_id, "fibonacci", "pick")
            event = await anext(events)
            while event.goal_id != expected or not isinstance(event, GoalInfo):
                event = await anext(events)
            assert event.parent == told
            follower = await arm.attach(expected)
            assert follower.feedback.stream.info.parent == told
            await goal.cancel()
            await follower.outcome()
        parents = {info.goal_id: info.parent for info in await arm.goals()}
        assert parents == {own.goal_id: None, expected: told}
        again = await arm.attach(expected)
        assert again.feedback.stream.info.parent == told

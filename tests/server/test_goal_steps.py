"""The steps of a goal at its server: what a planned stop leaves alone, and what a cancel reaches.

That they work over each transport is in the contract.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator

import anyio
import pytest

from fibaction import Action, ActionClient, ActionServer, GoalHandle
from tests.support.memory_store import MemoryStore
from tests.support.virtual_time import in_virtual_time

pytestmark = [pytest.mark.anyio, in_virtual_time()]

MISSION = Action("mission", goal=float, feedback=int, result=str)
PICK = Action("pick", goal=float, feedback=int, result=str)


async def pick(goal: GoalHandle[float]) -> AsyncGenerator[int | str, None]:
    """Work for as many seconds as the goal says."""
    await anyio.sleep(goal.request)
    yield "picked"


class Mission:
    """An executor with one step, which notes whether its goal was kept when it is interrupted."""

    def __init__(self, arm: ActionClient[float, int, str]) -> None:
        self._arm = arm
        self.kept: list[bool] = []

    async def __call__(self, goal: GoalHandle[float]) -> AsyncGenerator[int | str, None]:
        try:
            for name in "pick", "place":
                result = await self._arm.call(goal.request, step=goal.step(name))
            yield result
        except anyio.get_cancelled_exc_class():
            self.kept.append(goal.is_kept)
            raise


async def test_a_planned_stop_leaves_a_step_alone_and_the_next_attempt_follows_it() -> None:
    store = MemoryStore()
    async with ActionServer(PICK, pick, result_timeout=100) as arm:
        mission = Mission(ActionClient(arm, PICK))
        async with ActionServer(MISSION, mission, store=store, at_stop="keep") as server:
            goal = await ActionClient(server, MISSION).send_goal(10)
            await anyio.sleep(5)
        async with ActionServer(MISSION, mission, store=store, at_stop="keep") as server:
            begun = anyio.current_time()
            outcome = await (await ActionClient(server, MISSION).attach(goal.goal_id)).outcome()
            assert outcome.result == "picked"
            assert anyio.current_time() - begun < 16
        assert len(await ActionClient(arm, PICK).goals()) == 2
    assert mission.kept == [True]

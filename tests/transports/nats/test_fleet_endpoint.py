"""Goals, cancels and results of a fleet, at whichever worker they are."""

from __future__ import annotations

from collections.abc import AsyncGenerator

import anyio
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalAborted,
    GoalHandle,
)
from tests.transports.nats.fake_fleet import FakeFleet


async def count(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    for number in range(abs(goal.request)):
        yield number
    if goal.request < 0:
        await anyio.sleep_forever()
    yield str(goal.request)


COUNT = Action("count", goal=int, feedback=int, result=str)
"""Counts up to its goal, and then waits for a cancel if it is negative."""


def server() -> ActionServer[int, int, str]:
    return ActionServer(COUNT, count)


pytestmark = pytest.mark.anyio


@pytest.fixture
def fleet() -> FakeFleet:
    return FakeFleet()


async def test_a_goal_is_run_by_one_of_the_workers(fleet: FakeFleet) -> None:
    with anyio.fail_after(5):
        async with (
            fleet.worker("a").serve(server()),
            fleet.worker("b").serve(server()),
            fleet.connect() as connection,
        ):
            client = ActionClient(connection.endpoint(COUNT), COUNT)
            results = [await client.call(3) for _ in range(4)]
            assert results == ["3"] * 4
            assert sorted(fleet.lines.dialed) == ["a", "b"]


async def test_many_goals_at_once_need_few_questions(fleet: FakeFleet) -> None:
    with anyio.fail_after(5):
        async with (
            fleet.worker("a").serve(server()) as a,
            fleet.connect() as connection,
        ):
            client = ActionClient(connection.endpoint(COUNT), COUNT)
            async with anyio.create_task_group() as tasks:
                for number in range(100):
                    tasks.start_soon(client.call, number)
            assert len(a.asked) == 7


async def test_a_goal_moves_to_the_worker_that_has_taken_it_over(fleet: FakeFleet) -> None:
    with anyio.fail_after(5):
        async with (
            fleet.worker("a").serve(server()) as a,
            fleet.connect() as connection,
        ):
            client = ActionClient(connection.endpoint(COUNT), COUNT)
            goal = await client.send_goal(-3)
            assert [await anext(goal.feedback) for _ in range(3)] == [0, 1, 2]
            async with fleet.worker("b").serve(server()) as b:
                a.die()
                b.take_over("count", goal.goal_id)
                with pytest.raises(GoalAborted, match="restarted"):
                    await goal.result()
            assert goal.feedback.dropped == 0

"""The places of goals that wait, as observers are told them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack

import anyio
import pytest

from fibaction import ActionClient, ActionServer, GoalHandle, GoalStatus, Schedule
from fibaction.testing.contract.fibonacci import FIBONACCI, Feedback, Goal, Result
from fibaction.testing.contract.reach import Reach

pytestmark = pytest.mark.anyio


class OneByOne:
    """A server that runs one goal at a time, each until its event is set."""

    def __init__(self) -> None:
        self.started: dict[int, anyio.Event] = defaultdict(anyio.Event)
        self.go: dict[int, anyio.Event] = defaultdict(anyio.Event)
        schedule = Schedule(concurrency=1, queue=10)
        self.server = ActionServer(FIBONACCI, self.execute, schedule=schedule)

    async def execute(self, goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        self.started[goal.request.order].set()
        await self.go[goal.request.order].wait()
        yield Result([])


async def places(client: ActionClient[Goal, Feedback, Result]) -> list[tuple[int, int]]:
    """Return the places of the active goals, in the order of their acceptance."""
    active = [info for info in await client.goals() if info.status.is_active]
    active.sort(key=lambda info: info.stamp)
    for info in active:
        assert (info.status is GoalStatus.ACCEPTED) == (info.place > 0)
    return [(info.place, info.queue_length) for info in active]


@pytest.mark.promise("STATUS-9")
@pytest.mark.parametrize("is_followed", [False, True], ids=["list", "list and events"])
async def test_a_goal_that_waits_is_listed_with_its_place(reach: Reach, is_followed: bool) -> None:
    test = OneByOne()
    async with reach(test.server) as client, AsyncExitStack() as stack:
        if is_followed:  # on the same connection, before any goal waits
            await stack.enter_async_context(client.events())
        goals = [await client.send_goal(Goal(order)) for order in range(4)]
        await test.started[0].wait()
        assert await places(client) == [(0, 0), (1, 3), (2, 3), (3, 3)]
        await goals[2].cancel()
        assert await places(client) == [(0, 0), (1, 2), (2, 2)]
        test.go[0].set()
        await test.started[1].wait()
        await goals[0].result()
        assert await places(client) == [(0, 0), (1, 1)]
        for order in (1, 3):
            test.go[order].set()
        await goals[3].result()
        assert await places(client) == []

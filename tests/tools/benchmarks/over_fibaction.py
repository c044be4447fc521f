"""fibaction over `tcp://`, or over a transport served in the same way, as users write it."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from time import perf_counter
from typing import Any

from anyio import create_task_group

import fibaction
from fibaction import ActionClient, ActionServer, ClientGoal
from fibaction.wire.settings import Limits
from tests.tools.benchmarks.contender import (
    AT_ONCE,
    PACED,
    PENDING,
    Contender,
    GoalTimes,
    seconds_since,
)
from tests.tools.benchmarks.inprocess import ACTION, Goal, count

LIMITS = Limits(goals=20_000)
"""The limits for one client with more than 10,000 pending goals."""


@asynccontextmanager
async def serve(where: str = "tcp://127.0.0.1:0", **settings: Any) -> AsyncGenerator[str, None]:
    """Serve; `settings` are the server's."""
    server = ActionServer(ACTION, count, stall_timeout=math.inf, **settings)
    async with fibaction.serve(server, where, limits=LIMITS) as (url,):
        yield url


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    async with fibaction.connect(address, ACTION) as client:
        yield OverFibaction(client, Goal, lambda feedback: feedback.numbers)


class OverFibaction(Contender):
    def __init__(
        self,
        client: ActionClient[Any, Any, Any],
        goal: Callable[[int], Any],
        numbers_of: Callable[[Any], list[int]],
    ) -> None:
        self._client = client
        self._goal = goal
        self._numbers_of = numbers_of
        self._pending: list[ClientGoal[Any, Any]] = []

    async def goals(self, times: int) -> None:
        for _ in range(times):
            await self._client.call(self._goal(0))

    async def batches(self, times: int) -> int:
        for _ in range(times):
            async with create_task_group() as tasks:
                for _ in range(AT_ONCE):
                    tasks.start_soon(self._client.call, self._goal(0))
        return times * AT_ONCE

    async def feedback(self, times: int) -> int:
        seen = 0
        async with self._client.send_goal(self._goal(times)) as goal:
            async for _ in goal.feedback:
                seen += 1
            await goal.result()
        return seen

    async def goal_times(self, times: int) -> list[GoalTimes]:
        taken: list[GoalTimes] = []
        for _ in range(times):
            start = perf_counter()
            goal = await self._client.send_goal(self._goal(0))
            accepted = perf_counter() - start
            await goal.result()
            taken.append(GoalTimes(accepted, perf_counter() - start))
        return taken

    async def feedback_times(self, times: int) -> list[float]:
        taken: list[float] = []
        async with self._client.send_goal(self._goal(PACED + times)) as goal:
            taken += [seconds_since(self._numbers_of(one)) async for one in goal.feedback]
            await goal.result()
        return taken

    async def hold(self, times: int) -> None:
        for _ in range(times):
            self._pending.append(await self._client.send_goal(self._goal(PENDING)))

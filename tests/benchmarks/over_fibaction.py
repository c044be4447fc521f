"""fibaction over `tcp://`, by what a user would write."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

from anyio import create_task_group

import fibaction
from fibaction import ActionClient, ActionServer
from tests.benchmarks.contender import AT_ONCE, Contender
from tests.benchmarks.inprocess import ACTION, Feedback, Goal, Result, count


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    server = ActionServer(ACTION, count, stall_timeout=math.inf)
    async with fibaction.serve(server, "tcp://127.0.0.1:0") as (url,):
        yield url


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    async with fibaction.connect(address, ACTION) as client:
        yield OverFibaction(client)


class OverFibaction(Contender):
    def __init__(self, client: ActionClient[Goal, Feedback, Result]) -> None:
        self._client = client

    async def goals(self, times: int) -> None:
        for _ in range(times):
            await self._client.call(Goal(0))

    async def batches(self, times: int) -> None:
        for _ in range(times):
            async with create_task_group() as tasks:
                for _ in range(AT_ONCE):
                    tasks.start_soon(self._client.call, Goal(0))

    async def feedback(self, times: int) -> None:
        seen = 0
        async with self._client.send_goal(Goal(times)) as goal:
            async for _ in goal.feedback:
                seen += 1
            await goal.result()
        assert seen == times, "feedback was lost"

"""The limit in one process: anyio's tasks and memory object streams, without decisions."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import anyio

from tests.tools.benchmarks.contender import Contender, messages_of
from tests.tools.benchmarks.inprocess import Feedback

WINDOW = 64
"""Messages that may be unread, as in fibaction."""


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    yield OverTasks()


class OverTasks(Contender):
    async def goal(self) -> None:
        """Do nothing: a batch has a task for each."""

    async def goals(self, times: int) -> None:
        for _ in range(times):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(self.goal)

    async def numbers_of(self, goal: int) -> AsyncGenerator[list[int], None]:
        send, receive = anyio.create_memory_object_stream[Feedback](WINDOW)

        async def produce() -> None:
            async with send:
                async for message in messages_of(goal, Feedback):
                    await send.send(message)

        async with anyio.create_task_group() as tasks, receive:
            tasks.start_soon(produce)
            async for feedback in receive:
                yield feedback.numbers

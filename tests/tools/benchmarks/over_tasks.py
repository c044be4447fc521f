"""The limit in one process: anyio's tasks and memory object streams, without decisions."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import anyio

from tests.tools.benchmarks.contender import AT_ONCE, PAUSE, Contender, seconds_since, stamped
from tests.tools.benchmarks.inprocess import Feedback

WINDOW = 64
"""Messages that may be unread, as in fibaction."""


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    yield OverTasks()


class OverTasks(Contender):
    async def goals(self, times: int) -> None:
        for _ in range(times):
            await self._tasks(1)

    async def batches(self, times: int) -> int:
        for _ in range(times):
            await self._tasks(AT_ONCE)
        return times * AT_ONCE

    async def feedback(self, times: int) -> int:
        send, receive = anyio.create_memory_object_stream[Feedback](WINDOW)

        async def produce() -> None:
            feedback = Feedback([1, 2, 3])
            async with send:
                for _ in range(times):
                    await send.send(feedback)

        async with anyio.create_task_group() as tasks, receive:
            tasks.start_soon(produce)
            seen = [None async for _ in receive]
        return len(seen)

    async def feedback_times(self, times: int) -> list[float]:
        send, receive = anyio.create_memory_object_stream[Feedback](WINDOW)

        async def produce() -> None:
            async with send:
                for _ in range(times):
                    await anyio.sleep(PAUSE)
                    await send.send(Feedback(stamped()))

        async with anyio.create_task_group() as tasks, receive:
            tasks.start_soon(produce)
            taken = [seconds_since(feedback.numbers) async for feedback in receive]
        return taken

    async def _tasks(self, number: int) -> None:
        async with anyio.create_task_group() as tasks:
            for _ in range(number):
                tasks.start_soon(self._nothing)

    async def _nothing(self) -> None:
        pass

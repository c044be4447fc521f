"""`LoopTimes`: for how long anything keeps the event loop, by the clock of its thread."""

from __future__ import annotations

from contextlib import AsyncExitStack
from time import thread_time
from types import TracebackType
from typing import Self

import anyio


class LoopTimes:
    """Notes the longest step of the event loop during its block.

    It counts the time of the processor in the thread of the loop, so a busy machine does not count.
    """

    def __init__(self) -> None:
        self.longest = 0.0
        """Seconds of the longest step."""
        self._block = AsyncExitStack()

    async def __aenter__(self) -> Self:
        tasks = await self._block.enter_async_context(anyio.create_task_group())
        self._block.callback(tasks.cancel_scope.cancel)
        tasks.start_soon(self._watch)
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self._block.__aexit__(exc_type, exc, traceback)

    async def _watch(self) -> None:
        last = thread_time()
        while True:
            await anyio.sleep(0.001)
            now = thread_time()
            self.longest, last = max(self.longest, now - last), now

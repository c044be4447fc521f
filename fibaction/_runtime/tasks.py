"""Background tasks of a block of code."""

from __future__ import annotations

from types import TracebackType

from anyio import CancelScope, Event, create_task_group, sleep_forever
from anyio.abc import TaskGroup


class Background:
    """A task group that is canceled at the end of its block, and not before.

    If the block is canceled from outside, the tasks continue until the block has been left, because
    leaving it may need them: canceling a goal needs the tasks that read and write. An exception of
    the block is raised as itself; a task group would wrap it in an exception group, and so show its
    users that tasks exist. The tasks must not raise on purpose.
    """

    def __init__(self) -> None:
        self._host = create_task_group()
        self._life = CancelScope(shield=True)
        self._ready = Event()
        self._tasks: TaskGroup

    async def __aenter__(self) -> TaskGroup:
        await self._host.__aenter__()
        self._host.start_soon(self._hold)
        try:
            with CancelScope(shield=True):  # the wait takes one turn of the event loop
                await self._ready.wait()
        except BaseException:  # asyncio can cancel the task itself, which no scope shields
            await self.__aexit__(None, None, None)
            raise
        return self._tasks

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._life.cancel()
        await self._host.__aexit__(None, None, None)

    async def _hold(self) -> None:
        with self._life:
            async with create_task_group() as self._tasks:
                self._ready.set()
                await sleep_forever()

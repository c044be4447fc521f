"""Tasks that help a block of code, and end with it."""

from __future__ import annotations

from types import TracebackType

from anyio import CancelScope, Event, create_task_group, sleep_forever
from anyio.abc import TaskGroup


class Background:
    """A task group that is canceled at the end of its block, and not before.

    If the block is canceled from outside, its tasks go on until it has been left, because the way
    out may need them: to cancel a goal, somebody must still read and write. And the exception of
    the block goes on as itself: a task group would wrap it in a group, and its users would have to
    know that there are tasks. A task in it must raise nothing on purpose.
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
            with CancelScope(shield=True):  # it takes no time
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

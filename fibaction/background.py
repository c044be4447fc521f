"""Tasks that help a block of code, and end with it."""

from __future__ import annotations

from types import TracebackType

from anyio import create_task_group
from anyio.abc import TaskGroup


class Background:
    """A task group that is canceled at the end of its block.

    The exception of the block goes on as itself: a task group would wrap it in a group, and its
    users would have to know that there are tasks. A task in it must raise nothing on purpose.
    """

    def __init__(self) -> None:
        self._tasks: TaskGroup

    async def __aenter__(self) -> TaskGroup:
        self._tasks = create_task_group()
        return await self._tasks.__aenter__()

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._tasks.cancel_scope.cancel()
        await self._tasks.__aexit__(None, None, None)

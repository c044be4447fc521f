"""Tasks and turns of the event loop: background tasks, bulk work, and asyncio under anyio.

For example, a connection whose reader ends with the block that uses it, and not before:

    async with Background() as tasks:
        tasks.start_soon(line.read)
        yield connection

and a piece of work for very many goals, between whose slices all other tasks have their turns:

    slices = Slices()
    for goal in goals:
        ...
        await slices.pause()

`asyncio_task` and `asyncio_loop` serve transports over a library that knows asyncio only: without
a task of asyncio the program runs on trio.
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from types import TracebackType
from typing import TYPE_CHECKING, Any

from anyio import CancelScope, Event, create_task_group, current_time, sleep_forever
from anyio.abc import TaskGroup
from anyio.lowlevel import cancel_shielded_checkpoint

if TYPE_CHECKING:
    import asyncio  # noqa: TID251  # the one module that asks for it, for all

__all__ = ["SLICE", "Background", "Slices", "asyncio_loop", "asyncio_task", "loop_clock"]

SLICE = 0.001
"""Seconds of a slice: what a client's request for very many goals may delay all other clients."""


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


class Slices:
    """The slices of one piece of work, the first of which begins now.

    slices = Slices()
    for goal in goals:
        ...
        await slices.pause()
    """

    __slots__ = ("_end",)

    def __init__(self) -> None:
        self._end = perf_counter() + SLICE

    async def pause(self) -> None:
        """Give all other tasks a turn if the slice is over.

        It is not a cancellation point, so the work is done as a whole or not at all.
        """
        if perf_counter() >= self._end:
            await cancel_shielded_checkpoint()
            self._end = perf_counter() + SLICE


def asyncio_task() -> asyncio.Task[Any] | None:
    """Return the caller's task; None if it is one of trio, even as a guest of asyncio's loop."""
    import asyncio  # noqa: TID251  # not imported with `fibaction`, since a program may be of trio

    try:
        return asyncio.current_task()
    except RuntimeError:  # no loop of asyncio runs
        return None


def loop_clock() -> Callable[[], float]:
    """Return the clock of the caller's event loop, for code that needs the time very often.

    anyio's `current_time` looks for the loop at each call, which takes longer than to read a clock.
    """
    task = asyncio_task()
    return current_time if task is None else task.get_loop().time


def asyncio_loop() -> asyncio.AbstractEventLoop:
    """Return the event loop, and mark its callbacks as those of asyncio."""
    import asyncio  # noqa: TID251  # as above

    try:
        from sniffio import current_async_library_cvar
    except ImportError:
        pass  # anyio finds it out by itself
    else:
        current_async_library_cvar.set("asyncio")
    return asyncio.get_running_loop()

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

from fibaction._runtime.asyncio_task import asyncio_loop, asyncio_task
from fibaction._runtime.slices import SLICE, Slices
from fibaction._runtime.tasks import Background

__all__ = ["SLICE", "Background", "Slices", "asyncio_loop", "asyncio_task"]

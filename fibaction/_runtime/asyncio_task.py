"""asyncio behind anyio: its task, its event loop and its clock, which run the caller."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from anyio import current_time

if TYPE_CHECKING:
    import asyncio  # noqa: TID251  # the one module that asks for it, for all


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

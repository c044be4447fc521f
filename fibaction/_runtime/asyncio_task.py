"""asyncio behind anyio: its task and its event loop, which run the caller, and its events."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import anyio

if TYPE_CHECKING:
    import asyncio  # noqa: TID251  # the one module that asks for it, for all


def asyncio_task() -> asyncio.Task[Any] | None:
    """Return the caller's task; None if it is one of trio, also as a guest of asyncio's loop."""
    import asyncio  # noqa: TID251  # not imported with `fibaction`, since a program may be of trio

    try:
        return asyncio.current_task()
    except RuntimeError:  # no loop of asyncio runs
        return None


def new_event() -> anyio.Event | asyncio.Event:
    """Return an event for the tasks of this event loop.

    On asyncio it is asyncio's own: anyio's takes longer to make, and a goal that is sent needs two.
    """
    import asyncio  # noqa: TID251  # as above

    return anyio.Event() if asyncio_task() is None else asyncio.Event()


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

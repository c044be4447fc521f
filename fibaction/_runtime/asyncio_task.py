"""asyncio behind anyio: its task and its event loop, which run the caller."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import asyncio  # noqa: TID251  # the one module that asks for it, for all


def asyncio_task() -> asyncio.Task[Any] | None:
    """Return the caller's task; None if it is one of trio, even as a guest of asyncio's loop."""
    import asyncio  # noqa: TID251  # not imported with `fibaction`, since a program may be of trio

    try:
        return asyncio.current_task()
    except RuntimeError:  # no loop of asyncio runs
        return None


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

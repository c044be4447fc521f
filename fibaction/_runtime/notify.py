"""`Notifier`: a signal between parts of the library, which says only that something is new."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import anyio

if TYPE_CHECKING:
    import asyncio  # noqa: TID251  # the type of an event


def _new_event() -> anyio.Event | asyncio.Event:
    """Return an event for the tasks of this event loop.

    On asyncio it is asyncio's own: anyio's takes longer to make, and a goal that is sent needs two.
    """
    import asyncio  # noqa: TID251  # not imported with `fibaction`, since a program may be of trio

    try:  # as `asyncio_task` does, which would be one more call for each wait
        is_asyncio = asyncio.current_task() is not None
    except RuntimeError:  # no loop of asyncio runs
        is_asyncio = False
    return asyncio.Event() if is_asyncio else anyio.Event()


class Notifier:
    """A signal for any number of waiting tasks, and for one callback."""

    __slots__ = ("_event", "on_next")

    def __init__(self) -> None:
        self._event: anyio.Event | asyncio.Event | None = None
        self.on_next: Callable[[], None] | None = None
        """The callback of the next `notify()`, called once; None for none.

        It serves components that follow more streams than one task can wait for. It must not raise,
        and must leave the work to another turn of the event loop."""

    def notify(self) -> None:
        """Wake all tasks that wait now."""
        if self._event is not None:
            self._event.set()
            self._event = None
        on_next = self.on_next
        if on_next is not None:
            self.on_next = None
            on_next()

    async def wait(self) -> None:
        """Wait for the next `notify()`."""
        if self._event is None:
            self._event = _new_event()
        await self._event.wait()

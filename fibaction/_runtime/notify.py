"""`Notifier`: a signal between parts of the library, which says only that something is new."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import anyio

if TYPE_CHECKING:
    import asyncio  # noqa: TID251  # the type of a future


class Notifier:
    """A signal for any number of waiting tasks, and for one callback.

    On asyncio each wait is a future, which costs half as much as an event: a goal has two waits at
    least, and an event is two more objects for each.
    """

    __slots__ = ("_event", "_futures", "on_next")

    def __init__(self) -> None:
        self._futures: list[asyncio.Future[None]] | None = None
        self._event: anyio.Event | None = None  # for the tasks of trio
        self.on_next: Callable[[], None] | None = None
        """The callback of the next `notify()`, called once; None for none.

        It serves components that follow more streams than one task can wait for. It must not raise,
        and must leave the work to another turn of the event loop."""

    def notify(self) -> None:
        """Wake all tasks that wait now."""
        if self._futures:
            futures, self._futures = self._futures, None
            for future in futures:
                if not future.done():  # else its task was canceled just now
                    future.set_result(None)
        elif self._event is not None:
            self._event.set()
            self._event = None
        on_next = self.on_next
        if on_next is not None:
            self.on_next = None
            on_next()

    async def wait(self) -> None:
        """Wait for the next `notify()`."""
        import asyncio  # noqa: TID251  # not imported with `fibaction`: a program may be of trio

        try:  # as `asyncio_task` does, which would be one more call for each wait
            task = asyncio.current_task()
        except RuntimeError:  # no loop of asyncio runs
            task = None
        if task is None:
            self._event = self._event or anyio.Event()
            await self._event.wait()
            return
        future: asyncio.Future[None] = task.get_loop().create_future()
        futures = self._futures
        if futures is None:
            futures = self._futures = []
        futures.append(future)
        try:
            await future
        except BaseException:
            futures.remove(future)
            raise

"""`Notifier`: how one part tells another that something is new. What is new, it does not know."""

from __future__ import annotations

from collections.abc import Callable

import anyio


class Notifier:
    """Lets any number of tasks wait for "something is new", and one listener hear of it."""

    __slots__ = ("_event", "on_next")

    def __init__(self) -> None:
        self._event: anyio.Event | None = None
        self.on_next: Callable[[], None] | None = None
        """Called at the next `wake()`, once: for one who looks after more than a task can wait for.
        It must not raise, and not do the work itself."""

    def notify(self) -> None:
        """Wake all who wait now."""
        if self._event is not None:
            self._event.set()
            self._event = None
        on_next = self.on_next
        if on_next is not None:
            self.on_next = None
            on_next()

    async def wait(self) -> None:
        """Wait for the next `wake()`."""
        if self._event is None:
            self._event = anyio.Event()
        await self._event.wait()

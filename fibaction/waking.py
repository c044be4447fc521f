"""`Waking`: how one part tells another that something is new. What is new, it does not know."""

from __future__ import annotations

from collections.abc import Callable

import anyio


class Waking:
    """Lets any number of tasks wait for "something is new", and one listener hear of it."""

    __slots__ = ("_event", "listener")

    def __init__(self) -> None:
        self._event: anyio.Event | None = None
        self.listener: Callable[[], None] | None = None
        """Called at the next `wake()`, once: for one who looks after more than a task can wait for.
        It must not raise, and not do the work itself."""

    def wake(self) -> None:
        """Wake all who wait now."""
        if self._event is not None:
            self._event.set()
            self._event = None
        listener = self.listener
        if listener is not None:
            self.listener = None
            listener()

    async def wait(self) -> None:
        """Wait for the next `wake()`."""
        if self._event is None:
            self._event = anyio.Event()
        await self._event.wait()

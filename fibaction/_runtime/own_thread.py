"""`OwnThread`: an error for objects of an event loop that are used in another thread."""

from __future__ import annotations

from threading import current_thread, get_ident
from threading import enumerate as enumerate_threads

import anyio


class OwnThread:
    """The thread whose event loop an object belongs to.

    It is the one that makes the object in a task, or else the one that uses it first.
    """

    __slots__ = ("ident",)

    def __init__(self) -> None:
        self.ident = 0
        """The number of the thread; 0 before it is known."""
        try:
            anyio.get_current_task()
        except RuntimeError:
            return  # the object is made before the event loop runs
        self.ident = get_ident()

    def check(self) -> None:
        """Raise an error in another thread.

        Raises:
            RuntimeError: This is another thread; the text says what to do.
        """
        if get_ident() != self.ident:
            if self.ident:
                raise RuntimeError(
                    f"this client belongs to the event loop of thread {self._name()!r}, and was"
                    f" used in thread {current_thread().name!r}: call it in its own thread, for"
                    f" example with anyio.from_thread.run(client.call, goal)"
                )
            self.ident = get_ident()

    def _name(self) -> str:
        names = [thread.name for thread in enumerate_threads() if thread.ident == self.ident]
        return names[0] if names else "one that has ended"

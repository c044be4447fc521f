"""Objects of an event loop in another thread: an error for them, or calls into the event loop."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from threading import current_thread, get_ident
from threading import enumerate as enumerate_threads
from typing import TypeVar

import anyio
from anyio import RunFinishedError, from_thread
from anyio.lowlevel import current_token

T = TypeVar("T")


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


class HomeLoop:
    """The event loop that runs in the thread which makes this object."""

    __slots__ = ("_thread", "_token")

    def __init__(self) -> None:
        self._thread = get_ident()
        self._token = current_token()

    @property
    def is_here(self) -> bool:
        """True in the thread of the event loop."""
        return get_ident() == self._thread

    def run(self, function: Callable[[], Awaitable[T]]) -> T:
        """Run an async function in the event loop, as a task of its own; wait for it in this
        thread, which is another one.

        Raises:
            RuntimeError: The event loop has ended.
        """

        async def call() -> T:
            return await function()

        try:
            return from_thread.run(call, token=self._token)
        except RunFinishedError:
            raise RuntimeError("the event loop of the action server has ended") from None

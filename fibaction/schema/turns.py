"""`in_turn`: the work on documents of strangers, beside the event loop if they are large.

A check is Python, so a thread for it alone would take the interpreter from the event loop for 5 ms
at each of the loop's calls of the system. So the thread pauses about once in a millisecond, and
there is one such thread for an event loop: the documents of all clients wait for each other, in the
order in which they came, and small ones wait for none.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Generic, TypeAlias, TypeVar

import anyio
from anyio.lowlevel import RunVar

from fibaction.types.action import collector_paused

T = TypeVar("T")
Pause: TypeAlias = Callable[[], None]

SMALL = 2048
"""Bytes of a document that is checked at once: it takes less than a millisecond."""
PAUSE = 50e-6
"""Seconds of a pause, in which the event loop gets the interpreter if it waits for it."""

_turn = RunVar[anyio.CapacityLimiter]("_turn")


async def in_turn(size: int | None, work: Callable[[Pause | None], T]) -> T:
    """Return what the work on a document of so many bytes returns; None if that is not known.

    The work of a large one is done in a thread, and calls what it gets about once in a millisecond;
    that of a small one is done at once, and gets None.
    """
    if size is not None and size <= SMALL:
        return work(None)
    limiter = _turn.get(None)
    if limiter is None:
        limiter = anyio.CapacityLimiter(1)
        _turn.set(limiter)
    done = await anyio.to_thread.run_sync(_Done, work, limiter=limiter)
    return done.result()


class _Done(Generic[T]):
    """The outcome of some work, which is done at once.

    An error that a thread raises is in a cycle with the frame that waits for it. It would keep the
    document until the garbage collector comes.
    """

    def __init__(self, work: Callable[[Pause | None], T]) -> None:
        self._error: Exception | None = None
        # Each collection would go through all parts of the document, and find nothing.
        with collector_paused():
            try:
                self._result = work(_pause)
            except Exception as exc:
                self._error = exc

    def result(self) -> T:
        """Return what the work has returned, or raise its error, once."""
        if self._error is None:
            return self._result
        error, self._error = self._error, None
        try:
            raise error
        finally:
            del error


def _pause() -> None:
    time.sleep(PAUSE)  # noqa: TID251  # it lets go of the interpreter's lock

"""SIGINT and SIGTERM as they come, on every system.

Theory of operation
-------------------

The event loop of Unix learns of a signal from a file descriptor that Python's own handler writes
to, so a handler in Python may be set beside it: that one is called also while the loop is blocked.
The event loop of Windows has no such receiver. There, Python wakes it at each signal, and the
handler itself tells it.

Windows has no SIGTERM from elsewhere. It has SIGBREAK, by Ctrl-Break and by a program that stops
another one.
"""

from __future__ import annotations

import signal
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack
from typing import Any, Final, TypeAlias

import anyio

from fibaction._runtime.asyncio_task import asyncio_loop

Handler: TypeAlias = Callable[[int, object], None]

NUMBERS: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGBREAK") if hasattr(signal, name)
)
"""The signals that end a verb."""
MOST_AT_ONCE = 8
"""Signals that may come before they are taken; more count as these."""


def handle_with(handler: Handler) -> None:
    """Make this the handler of the signals."""
    for number in NUMBERS:
        signal.signal(number, handler)


class ReceivedSignals:
    """Receives the signals, one for each `next`, during its block.

    The handler gets each of them at once, also while the event loop is blocked.
    """

    def __init__(self, handler: Handler) -> None:
        self._handler = handler
        self._stack = ExitStack()
        self._signals: AsyncIterator[Any]

    def __enter__(self) -> None:
        """Begin to receive."""
        try:
            self._signals = self._stack.enter_context(anyio.open_signal_receiver(*NUMBERS))
        except NotImplementedError:
            self._signals = self._receive_by_handler()
        else:
            handle_with(self._handler)

    def __exit__(self, *_: object) -> None:
        """Restore the handlers from before."""
        self._stack.close()

    async def next(self) -> None:
        """Wait for the next signal."""
        await anext(self._signals)

    def _receive_by_handler(self) -> AsyncIterator[int]:
        loop = asyncio_loop()
        come, taken = anyio.create_memory_object_stream[int](MOST_AT_ONCE)
        self._stack.callback(come.close)
        self._stack.callback(taken.close)

        def tell(number: int) -> None:
            if come.statistics().current_buffer_used < MOST_AT_ONCE:
                come.send_nowait(number)

        def handle(number: int, frame: object) -> None:
            loop.call_soon_threadsafe(tell, number)
            self._handler(number, frame)

        for number in NUMBERS:
            self._stack.callback(signal.signal, number, signal.getsignal(number))
            signal.signal(number, handle)
        return taken

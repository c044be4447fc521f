"""A queue from any thread to the event loop."""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from threading import Lock
from typing import Any, TypeAlias

import anyio

from fibaction._log import clean_logger

MAILBOX = 20_000
"""Items that may wait for the event loop. With more, nothing is taken, and messages wait in the
middleware, whose queues have depths of their own."""
TURN = 64
"""Items that are handled before other tasks get their turn on the event loop."""

Sink: TypeAlias = Callable[[Any], None]
"""Handles an item on the event loop, without waiting."""

logger = clean_logger("fibaction.ros2")


class Mailbox:
    """A queue of items for the event loop, filled by any thread.

    One byte in a pair of sockets wakes the event loop, be it asyncio's or trio's, for all items
    that wait.
    """

    def __init__(self, room: Callable[[], None]) -> None:
        """`room` is called on the event loop when the mailbox is no longer full."""
        self._room = room
        self._items: deque[tuple[Sink, Any]] = deque()
        self._lock = Lock()
        self._awake = False
        self._full = False
        self._reader, self._writer = socket.socketpair()
        self._reader.setblocking(False)
        self._writer.setblocking(False)

    @property
    def is_full(self) -> bool:
        """True if nothing more is to be put in for now; `room` will be called."""
        self._full = len(self._items) >= MAILBOX
        # The loop may have emptied it between this look and this note, without calling `room`.
        return self._full and len(self._items) >= MAILBOX

    def put(self, items: list[tuple[Sink, Any]]) -> None:
        """Add items, from any thread."""
        self._items.extend(items)
        with self._lock:
            if self._awake:
                return
            self._awake = True
            with suppress(OSError):  # the mailbox is closed
                self._writer.send(b"\0")

    async def run(self) -> None:
        """Handle items until canceled."""
        while True:
            await anyio.wait_readable(self._reader)
            with self._lock:
                self._reader.recv(16)
                self._awake = False
            while self._items:
                self._handle_some()
                if self._full and len(self._items) < MAILBOX // 2:
                    self._full = False
                    self._room()
                await anyio.lowlevel.checkpoint()

    def _handle_some(self) -> None:
        for _ in range(min(len(self._items), TURN)):
            sink, item = self._items.popleft()
            try:
                sink(item)
            except Exception:
                logger.exception("a message was dropped, because it could not be handled")

    def close(self) -> None:
        """Drop all items, and handle no more."""
        self._items.clear()
        self._reader.close()
        self._writer.close()

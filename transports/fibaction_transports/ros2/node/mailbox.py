"""The way of what arrives in a middleware's own threads to the event loop."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from threading import Lock
from typing import Any, TypeAlias

import anyio
from anyio.lowlevel import EventLoopToken, current_token

from fibaction.border.abc import Notifier
from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import ProtocolError

MAILBOX = 20_000
"""Items that may wait for the event loop. With more, nothing is taken, and messages wait in the
middleware, whose queues have depths of their own."""
TURN = 64
"""Items that are handled before other tasks get their turn on the event loop."""

Sink: TypeAlias = Callable[[Any], None]
"""Handles an item on the event loop, without waiting."""

logger = clean_logger("fibaction.ros2")


class Drops:
    """Counts what is dropped. The 1st, 2nd, 4th, 8th and so on are told in the log."""

    def __init__(self, what: str) -> None:
        self._what = what
        self.count = 0

    def note(self, why: object, number: int = 1) -> None:
        """Note that so many were dropped."""
        before, self.count = self.count, self.count + number
        if before.bit_length() < self.count.bit_length():
            logger.warning("%s was dropped (%d so far): %s", self._what, self.count, why)


MOST_PUBLISHERS = 1_000
"""Publishers of a topic whose numbers are known."""


class MessageNumbers:
    """Counts the messages of a topic that are missing, by the numbers of its publishers."""

    def __init__(self, topic: str) -> None:
        self._lost = Drops(f"a message on {topic}")
        self._tell: Callable[[int], None] = lambda count: None
        self._last: dict[bytes, int] = {}
        """The number of the last message of each publisher, that of the last one at the end."""

    def tell(self, take: Callable[[int], None]) -> None:
        """Call `take` with the number of messages that are missing, before that which shows it."""
        self._tell = take

    def note(self, publisher: bytes, number: int) -> None:
        """Note the number of a message. A publisher drops messages that find its queue full."""
        before = self._last.pop(publisher, number)
        self._last[publisher] = number
        if len(self._last) > MOST_PUBLISHERS:
            del self._last[next(iter(self._last))]
        if number > before + 1:
            self._lost.note("its publisher, or the way, was overloaded", number - before - 1)
            self._tell(number - before - 1)

    def forget(self, publisher: bytes) -> None:
        """Forget a publisher that has gone."""
        self._last.pop(publisher, None)


class Mailbox:
    """A queue of items for the event loop, filled by any thread.

    The event loop is woken once for all items that wait, be it asyncio's or trio's.
    """

    def __init__(self, room: Callable[[], None]) -> None:
        """`room` is called on the event loop when the mailbox is no longer full."""
        self._room = room
        self._drops = Drops("a message")
        self._items: deque[tuple[Sink, Any]] = deque()
        self._lock = Lock()
        self._news = Notifier()
        self._token: EventLoopToken | None = None
        """The event loop while it sleeps until there are items; None otherwise."""
        self._full = False

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
            token, self._token = self._token, None
            if token is not None:
                with suppress(RuntimeError):  # the event loop has ended
                    token.backend_class.run_sync_soon(self._news.notify, (), token.native_token)

    async def run(self) -> None:
        """Handle items until canceled."""
        here = current_token()
        while True:
            while self._items:
                self._handle_some()
                if self._full and len(self._items) < MAILBOX // 2:
                    self._full = False
                    self._room()
                if self._items:
                    await anyio.lowlevel.checkpoint()
            with self._lock:
                if self._items:
                    continue  # they were added just now
                self._token = here
            await self._news.wait()

    def _handle_some(self) -> None:
        for _ in range(min(len(self._items), TURN)):
            sink, item = self._items.popleft()
            try:
                sink(item)
            except ProtocolError as exc:
                self._drops.note(exc)
            except Exception:
                logger.exception("a message was dropped, because it could not be handled")

    def close(self) -> None:
        """Drop all items, and handle no more."""
        with self._lock:
            self._token = None
        self._items.clear()

"""From the thread that rclpy spins to the event loop: what has arrived, and nothing else.

The `Intake` takes all that there is of each handle and hands it over in a `Mailbox`; what becomes
of it is decided on the event loop. No code of users and no rule of actions is run in the thread,
and nothing is raised in it: an exception would end the spinning.
"""

from __future__ import annotations

import logging
import socket
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from threading import Lock
from types import TracebackType
from typing import Any, TypeAlias

import anyio

from fibaction_transports.ros2.rcl import InvalidHandle, ReentrantCallbackGroup, waitable

MAILBOX = 20_000
"""How many items may wait for the event loop; then no more is taken, and what arrives waits in the
middleware, whose queues have depths of their own."""
TURN = 64
"""How many items are handled before others get their turn on the event loop."""

Sink: TypeAlias = Callable[[Any], None]
"""Handles an item on the event loop; it does not wait."""

logger = logging.getLogger("fibaction.ros2")


class Mailbox:
    """Items for the event loop, put by any thread.

    A byte in a pair of sockets wakes the loop, whichever it is: one for all items that wait.
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
        """Whether to take no more for now; `room` will be called."""
        self._full = len(self._items) >= MAILBOX
        # The loop may have emptied it between that look and that note, and told nobody: look again.
        return self._full and len(self._items) >= MAILBOX

    def put(self, items: list[tuple[Sink, Any]]) -> None:
        """Hand over items."""
        self._items.extend(items)
        with self._lock:
            if self._awake:
                return
            self._awake = True
            with suppress(OSError):  # it is closed, and nobody waits any more
                self._writer.send(b"\0")

    async def run(self) -> None:
        """Handle what comes, for ever."""
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
        """No more is handled."""
        self._items.clear()
        self._reader.close()
        self._writer.close()


class Source(ABC):
    """A raw handle that things arrive at."""

    kind: str
    """What the wait set calls it."""

    def __init__(self, handle: Any, sink: Sink, unread: Sink | None = None) -> None:
        """`unread` is handed the error if something cannot be taken."""
        self.handle = handle
        self.index: int | None = None
        self._sink = sink
        self._unread = unread

    @abstractmethod
    def take(self) -> Any:
        """What has arrived first; None if there is nothing."""

    def take_all(self) -> list[tuple[Sink, Any]]:
        """All that has arrived, each with its sink."""
        items: list[tuple[Sink, Any]] = []
        failures = 0
        while len(items) < MAILBOX and failures < TURN:
            try:
                item = self.take()
            except InvalidHandle:
                break  # it has just been destroyed
            except Exception as exc:
                # For instance text that is no Unicode. It has been taken all the same.
                failures += 1
                logger.error("a message could not be taken: %s", exc)
                if self._unread is not None:
                    items.append((self._unread, exc))
            else:
                if item is None:
                    break
                items.append((self._sink, item))
        return items


class Requests(Source):
    """What clients ask a service: `(header, request)`."""

    kind = "service"

    def __init__(self, handle: Any, service_type: Any, sink: Sink) -> None:
        super().__init__(handle, sink)
        self._type = service_type.Request

    def take(self) -> Any:
        request, header = self.handle.service_take_request(self._type)
        return None if header is None else (header.request_id, request)


class Responses(Source):
    """What a service answers: `(number of the request, response)`."""

    kind = "client"

    def __init__(
        self, handle: Any, service_type: Any, sink: Sink, unread: Sink | None = None
    ) -> None:
        super().__init__(handle, sink, unread)
        self._type = service_type.Response

    def take(self) -> Any:
        header, response = self.handle.take_response(self._type)
        return None if header is None else (header.request_id.sequence_number, response)


class Messages(Source):
    """What is published to a topic, as bytes: most of it may be of no interest."""

    kind = "subscription"

    def __init__(self, handle: Any, message_type: Any, sink: Sink) -> None:
        super().__init__(handle, sink)
        self._type = message_type

    def take(self) -> Any:
        taken = self.handle.take_message(self._type, True)
        return None if taken is None else taken[0]


_COUNTS = {
    "subscription": "num_subscriptions",
    "service": "num_services",
    "client": "num_clients",
}


class Intake(waitable.Waitable):  # type: ignore[misc]  # rclpy has no types here
    """Takes from all its sources whatever arrives, when an executor of rclpy spins it."""

    def __init__(self, mailbox: Mailbox) -> None:
        waitable.Waitable.__init__(self, ReentrantCallbackGroup())
        self._mailbox = mailbox
        self._lock = Lock()
        self._sources: tuple[Source, ...] = ()
        self._entered: list[Source] = []
        self._ready: list[Source] = []

    def add(self, *sources: Source) -> None:
        """Take from these, too, after the executor has been woken.

        What has arrived together is handed over in the order of the sources, and taken in the
        reverse order. So feedback that was sent before a result is also seen before it, if it is
        added before.
        """
        with self._lock:
            self._sources += sources

    def clear(self) -> None:
        """Take no more."""
        with self._lock:
            self._sources = ()

    # What an executor calls, in its thread and in this order

    def __enter__(self) -> None:
        self._entered = []
        if self._mailbox.is_full:
            return
        for source in self._sources:
            with suppress(InvalidHandle):  # it is being destroyed
                source.handle.__enter__()
                self._entered.append(source)

    def get_num_entities(self) -> Any:
        number = waitable.NumberOfEntities()
        for source in self._entered:
            name = _COUNTS[source.kind]
            setattr(number, name, getattr(number, name) + 1)
        return number

    def add_to_wait_set(self, wait_set: Any) -> None:
        for source in self._entered:
            source.index = getattr(wait_set, f"add_{source.kind}")(source.handle)

    def is_ready(self, wait_set: Any) -> bool:
        self._ready = [
            source for source in self._entered if wait_set.is_ready(source.kind, source.index)
        ]
        return bool(self._ready)

    def take_data(self) -> None:
        taken: list[tuple[Sink, Any]] = []
        ready = {id(source) for source in self._ready}
        for source in reversed(self._entered):
            # A result is ready, and its feedback has come since: so look at those before, too.
            if id(source) in ready or (taken and source.kind == "subscription"):
                taken[:0] = source.take_all()
        self._mailbox.put(taken)

    async def execute(self, taken_data: None) -> None:
        """All is done by then."""

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc_val: BaseException | None,
        exc_tb: TracebackType | None,
    ) -> None:
        for source in self._entered:
            source.handle.__exit__(exc_type, exc_val, exc_tb)

"""The waitable of a node: takes what has arrived, in the thread that spins the node.

It takes everything that is there for each handle, and puts it into a `Mailbox`. The event loop
decides what becomes of it. The thread runs no code of users and no rule of actions, and raises
nothing: an exception would end the spinning.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import suppress
from threading import Lock
from types import TracebackType
from typing import Any

from fibaction.border.peer_text import clean_logger
from fibaction_transports.ros2.node.mailbox import MAILBOX, TURN, Mailbox, Sink
from fibaction_transports.ros2.on_rclpy.rcl import InvalidHandle, ReentrantCallbackGroup, waitable

logger = clean_logger("fibaction.ros2")


class Source(ABC):
    """A raw handle, and the sink of what arrives there."""

    kind: str
    """The handle's kind, as the wait set names it."""

    def __init__(self, handle: Any, sink: Sink, unread: Sink | None = None) -> None:
        """`unread` is called with the error if something cannot be taken."""
        self.handle = handle
        self.index: int | None = None
        self.is_paused = False
        """True if nothing is to be taken for now, so that it waits in the middleware."""
        self._sink = sink
        self._unread = unread

    @abstractmethod
    def take(self) -> Any:
        """Take what has arrived first; None if there is nothing."""

    def take_all(self) -> list[tuple[Sink, Any]]:
        """Take all that has arrived, each with its sink."""
        items: list[tuple[Sink, Any]] = []
        failures = 0
        while len(items) < MAILBOX and failures < TURN:
            try:
                item = self.take()
            except InvalidHandle:
                break  # it has just been destroyed
            except Exception as exc:
                # For instance, text that is not valid Unicode. The middleware has dropped it.
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
    """The requests to a service: `(header, request)`."""

    kind = "service"

    def __init__(self, handle: Any, service_type: Any, sink: Sink) -> None:
        super().__init__(handle, sink)
        self._type = service_type.Request

    def take(self) -> Any:
        request, header = self.handle.service_take_request(self._type)
        return None if header is None else (header.request_id, request)


class Responses(Source):
    """The responses of a service: `(number of the request, response)`."""

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
    """The messages of a topic: `(message, publisher)`. The message is bytes, because most may be
    ignored. The publisher is its GID; empty if the middleware or rclpy does not tell it.
    """

    kind = "subscription"

    def __init__(self, handle: Any, message_type: Any, sink: Sink) -> None:
        super().__init__(handle, sink)
        self._type = message_type

    def take(self) -> Any:
        taken = self.handle.take_message(self._type, True)
        if taken is None:
            return None
        message, info = taken
        publisher: Any = info.get("publisher_gid")
        return message, publisher["data"] if publisher else b""


_COUNTS = {
    "subscription": "num_subscriptions",
    "service": "num_services",
    "client": "num_clients",
}


class RosWaitable(waitable.Waitable):  # type: ignore[misc]  # rclpy has no types here
    """Takes from its sources whatever arrives, spun by a `Spinner` or by an executor of rclpy."""

    def __init__(self, mailbox: Mailbox) -> None:
        waitable.Waitable.__init__(self, ReentrantCallbackGroup())
        self._mailbox = mailbox
        self._lock = Lock()
        self._sources: tuple[Source, ...] = ()
        self._entered: list[Source] = []
        self._ready: list[Source] = []
        self.is_spun = False
        """True if an executor has waited for it."""

    def add(self, *sources: Source, first: bool = False) -> None:
        """Take from these sources, too. It has an effect after the executor has been woken.

        Items that have arrived together are put in the order of the sources, and taken in the
        reverse order. So feedback that was sent before a result is also handled before it, if its
        source is added first, or later with `first`.
        """
        with self._lock:
            self._sources = sources + self._sources if first else self._sources + sources

    @property
    def is_paused(self) -> bool:
        """True if nothing is to be taken for now, because the mailbox is full."""
        return self._mailbox.is_full

    def remove(self, handle: Any) -> None:
        """Take no more from the source with this handle, if there is one."""
        with self._lock:
            self._sources = tuple(one for one in self._sources if one.handle is not handle)

    def clear(self) -> None:
        """Remove all sources."""
        with self._lock:
            self._sources = ()

    # Methods that are called in the thread that spins, in this order

    def __enter__(self) -> RosWaitable:
        self.is_spun = True
        self._entered = []
        for source in () if self.is_paused else self._sources:
            if source.is_paused:
                continue
            with suppress(InvalidHandle):  # it is being destroyed
                source.handle.__enter__()
                self._entered.append(source)
        return self

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
            # If a result is ready, its feedback may have arrived since the wait: take that, too.
            if id(source) in ready or (taken and source.kind == "subscription"):
                taken[:0] = source.take_all()
        self._mailbox.put(taken)

    async def execute(self, taken_data: None) -> None:
        """Do nothing: `take_data` has done all."""

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc_val: BaseException | None,
        exc_tb: TracebackType | None,
    ) -> None:
        for source in self._entered:
            source.handle.__exit__(exc_type, exc_val, exc_tb)

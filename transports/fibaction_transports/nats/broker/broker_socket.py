"""`BrokerSocket`: the protocol of NATS on a connection to one broker, after the login.

The event loop calls `buffer_updated` with what has arrived, and all messages in it are handed over
in the same turn, without tasks and futures: a goal needs few messages, so these would be a good
part of what it costs. Messages to send are joined by the caller.
"""

from __future__ import annotations

import asyncio  # noqa: TID251  # each message is a callback, which anyio has not
from collections.abc import Callable, Mapping
from typing import Any

import anyio

from fibaction.border.abc import Notifier
from fibaction.border.peer_text import clean_logger
from fibaction.wire.channel import CHUNK
from fibaction_transports.nats.broker.broker import NO_HEADERS, Message
from fibaction_transports.nats.broker.login import BrokerInfo

MISSED_PINGS = 2
"""Pings without an answer after which a broker counts as lost, when it is time for the next."""
CUT_TIMEOUT = 1.0
"""Seconds in which a connection that was cut is closed."""
LONGEST_LINE = 2**20
"""Bytes of a line of the protocol; an INFO of a large cluster has many."""
CRLF = b"\r\n"

logger = clean_logger("fibaction.nats")


def published(
    subject: str, data: bytes, reply: str, headers: Mapping[str, str] | None
) -> tuple[bytes, bytes, bytes]:
    """Return a message as the parts to write."""
    if headers is None:
        return f"PUB {subject} {reply} {len(data)}\r\n".encode(), data, CRLF
    lines = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
    block = f"NATS/1.0\r\n{lines}\r\n"
    size = len(block.encode())
    head = f"HPUB {subject} {reply} {size} {size + len(data)}\r\n{block}"
    return head.encode(), data, CRLF


def headers_of(block: bytes) -> dict[str, str]:
    """Return the headers of a message; the status that a broker gives by itself is `Status`."""
    first, *lines = block.decode("utf-8", "replace").split("\r\n")
    headers: dict[str, str] = {}
    if " " in first:
        headers["Status"] = first.split(" ", 2)[1]
    for line in lines:
        if line:
            name, _, value = line.partition(":")
            headers[name] = value.strip()
    headers.pop("", None)
    return headers


class BrokerSocket(asyncio.BufferedProtocol):
    """A connection to one broker."""

    def __init__(
        self,
        transport: Any,
        info: BrokerInfo,
        deliver: Callable[[int, Message], None],
        on_change: Callable[[], None],
    ) -> None:
        """Take over a connection.

        `deliver` gets each message, with the number of its subscription. `on_change` is called
        when there is room to write again, and when the connection is lost.
        """
        self._transport = transport
        self.info = info
        """The INFO of the broker."""
        self._deliver = deliver
        self._on_change = on_change
        self._buffer = memoryview(bytearray(CHUNK))
        self._parts: list[bytes] = []  # of a message that has not arrived as a whole
        self._missing = 0  # bytes of it, as far as its size is known
        self._pings = 0
        self._is_closed = False
        self._closed = Notifier()
        self._is_full = False  # what was written waits for the broker

    def begin(self, early: bytes) -> None:
        """Read from now on; `early` was read before."""
        self._transport.set_protocol(self)
        self._take(early)

    @property
    def is_lost(self) -> bool:
        """True if the connection is closed, or is being closed."""
        return self._is_closed or bool(self._transport.is_closing())

    @property
    def is_ready(self) -> bool:
        """True if messages can be written now."""
        return not (self._is_full or self.is_lost)

    def write(self, data: bytes) -> None:
        """Send messages; they are lost if the connection is."""
        self._transport.write(data)

    def ping(self) -> None:
        """Ask whether the broker is there, or cut the connection if it has not answered before."""
        if self._pings >= MISSED_PINGS:
            self._transport.abort()
        else:
            self._pings += 1
            self.write(b"PING\r\n")

    async def cut(self) -> None:
        """Close the connection at once."""
        self._transport.abort()
        with anyio.move_on_after(CUT_TIMEOUT, shield=True):
            while not self._is_closed:
                await self._closed.wait()

    # Called by the event loop

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        self._pings = 0  # a broker that sends is there; its PONG may wait behind many records
        self._take(bytes(self._buffer[:nbytes]))

    def pause_writing(self) -> None:
        self._is_full = True

    def resume_writing(self) -> None:
        self._is_full = False
        self._on_change()

    def connection_lost(self, exc: Exception | None) -> None:
        self._is_closed = True
        self._closed.notify()
        self._on_change()

    # Reading

    def _take(self, data: bytes) -> None:
        """Handle all that has arrived as a whole."""
        self._parts.append(data)
        self._missing -= len(data)
        if self._missing > 0:
            return
        data = b"".join(self._parts)
        try:
            rest = data[self._handle(data) :]
        except ValueError as exc:
            logger.warning("a broker does not speak the protocol of NATS: %s", exc)
            self._transport.abort()
            rest = b""
        self._parts = [rest] if rest else []

    def _handle(self, data: bytes) -> int:
        """Handle messages, and return the number of bytes that they had.

        Raises:
            ValueError: This is not the protocol of NATS.
        """
        at, end, self._missing = 0, len(data), 0
        while (stop := data.find(CRLF, at)) >= 0:
            words = data[at:stop].decode("utf-8", "replace").split(" ")
            has_headers = words[0] == "HMSG"
            if not (has_headers or words[0] == "MSG"):
                self._control(words)
                at = stop + 2
                continue
            start = stop + 2
            after = start + int(words[-1])
            if after + 2 > end:
                self._missing = after + 2 - end
                return at
            headers: Mapping[str, str] = NO_HEADERS
            if has_headers:
                block = start + int(words.pop(-2))
                headers, start = headers_of(data[start:block]), block
            reply = words[3] if len(words) > 4 else ""
            message = Message(words[1], data[start:after], reply, headers)
            self._hand_over(int(words[2]), message)
            at = after + 2
        if end - at > LONGEST_LINE:
            raise ValueError("a line is too long")
        return at

    def _hand_over(self, number: int, message: Message) -> None:
        try:
            self._deliver(number, message)
        except Exception:
            logger.exception("a message to %s could not be handled", message.subject)

    def _control(self, words: list[str]) -> None:
        """Handle a line that is not a message."""
        if words[0] == "PING":
            self.write(b"PONG\r\n")
        elif words[0] == "-ERR":  # the broker closes the connection, if it has to
            logger.debug("a broker reports %s", " ".join(words[1:]))
        elif words[0] not in ("INFO", "+OK", "PONG"):
            raise ValueError(f"an unknown message {words[0]!r}")

"""The messages of rosbridge over WebSocket: in pieces and fragments, and as frames of a client.

A frame of a client is the text of one message. Three frames are signs: `OPENED` is received first,
once the server has accepted the WebSocket; `PING` is sent as a ping; `INVALID` is sent last, after
a message of the server that cannot be read, and goes into the code of the close.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager

import msgspec
from wsproto.events import Event, Ping, TextMessage

from fibaction.border.byte_budgets import ByteBudget
from fibaction.wire.frames import FrameMemory
from fibaction.wire.link import PING
from fibaction.words.errors import LimitReached, ProtocolError
from fibaction_transports.web.http import websocket_frames
from fibaction_transports.web.http.handshake import ClientHandshake
from fibaction_transports.web.http.websocket_frames import (
    NORMAL,
    TOO_BIG,
    UNSUPPORTED,
    SocketMessages,
    WebSocketFraming,
)
from fibaction_transports.web.rosbridge.operations import ClientID, Fragment

LEAST_FRAGMENT = 1024
"""Characters of the smallest fragments: smaller ones would consist of their names."""
BINARY = "it sent a binary message: rosbridge has JSON in text messages here"
OVERHEAD = 100
"""Bytes that a fragment costs next to its own text."""
OPENED = b""
"""The frame that says that the server has accepted the WebSocket."""
INVALID = b"\0"
"""The frame that says that a message of the server is invalid. It is not JSON, as messages are."""


def size_of(text: str) -> int:
    """Return the length of a text in bytes."""
    return len(text) if text.isascii() else len(text.encode("utf-8", "replace"))


class PartialMessages:
    """The messages of a client that have not arrived completely, within a limit.

    A message may arrive in pieces of WebSocket, whose end is marked, and in fragments, which may
    come in any order. All of them count in the memory that the connections of a server share.
    """

    def __init__(self, limit: int, memory: FrameMemory) -> None:
        """Hold at most `limit` bytes."""
        self.limit = limit
        self._memory = memory
        self._pieces: list[str] = []
        self._in_pieces = self._in_fragments = self._in_work = 0
        self._fragments: dict[ClientID, dict[int, str]] = {}
        self._is_given_up = False

    @property
    def is_empty(self) -> bool:
        """True if no message is incomplete but for its fragments."""
        return not self._pieces

    def add_piece(self, text: str, *, is_last: bool) -> str | None:
        """Add a piece of the message that is arriving; return the message if it is complete.

        Raises:
            LimitReached: The server has no room for it.
            ProtocolError: It is larger than the limit.
        """
        self._in_pieces += size_of(text)
        self._check(self._in_pieces, "message")
        if is_last and not self._pieces:
            self._in_pieces = 0
            return text
        self._pieces.append(text)
        if is_last:
            text, self._pieces, self._in_pieces = "".join(self._pieces), [], 0
        self._count()
        return text if is_last else None

    def add_fragment(self, fragment: Fragment) -> str | None:
        """Add a fragment; return the message if it is complete.

        Raises:
            LimitReached: The server has no room for it.
            ProtocolError: The fragments are larger than the limit, or do not belong together.
        """
        parts = self._fragments.setdefault(fragment.id, {})
        if fragment.num >= fragment.total or fragment.num in parts or len(parts) >= fragment.total:
            raise ProtocolError("it sent a fragment with a number that cannot be")
        parts[fragment.num] = fragment.data
        self._in_fragments += size_of(fragment.data) + OVERHEAD
        self._check(self._in_fragments, "message in fragments")
        message: str | None = None
        if len(parts) == fragment.total:
            del self._fragments[fragment.id]
            if set(parts) != set(range(fragment.total)):
                raise ProtocolError("it sent a fragment with a number that cannot be")
            message = "".join(parts[num] for num in range(fragment.total))
            self._in_fragments -= sum(map(size_of, parts.values())) + OVERHEAD * len(parts)
        self._count()
        return message

    @contextmanager
    def held(self, text: str) -> Generator[None, None, None]:
        """Count a message that has arrived until the end of the block."""
        self._in_work = size_of(text)
        self._count()
        try:
            yield
        finally:
            self._in_work = 0
            self._count()

    def _check(self, size: int, what: str) -> None:
        if self._is_given_up:
            raise LimitReached(f"the server is busy: it has no room for a large {what}")
        if size > self.limit:
            raise ProtocolError(f"{what} of {size} bytes exceeds the limit of {self.limit} bytes")

    def _count(self) -> None:
        self._memory.hold(self, self._in_pieces + self._in_fragments + self._in_work)

    def give_up(self) -> None:
        """Forget everything, and fail as soon as more comes."""
        self._is_given_up = True
        self.close()

    def close(self) -> None:
        """Forget everything: no more comes."""
        self._pieces, self._fragments = [], {}
        self._in_pieces = self._in_fragments = self._in_work = 0
        self._count()


class TextMessages(SocketMessages):
    """Text messages, with one operation in each, which is a frame as it is."""

    def __init__(self, partial: PartialMessages) -> None:
        self.partial = partial

    def take(self, data: bytes | str, *, is_last: bool) -> list[bytes]:
        if isinstance(data, bytes):
            self.code = UNSUPPORTED
            raise ProtocolError(BINARY)
        self.code = TOO_BIG
        text = self.partial.add_piece(data, is_last=is_last)
        self.code = NORMAL
        return [] if text is None else self.frames_of(text)

    def frames_of(self, text: str) -> list[bytes]:
        """Return the frames that a whole message is."""
        return [text.encode()]

    @property
    def is_within_frame(self) -> bool:
        return not self.partial.is_empty

    def close(self) -> None:
        self.partial.close()


def in_fragments(text: str, message_id: ClientID, size: int | None) -> list[str]:
    """Return a message as it is sent: in fragments, if it is longer than the client wants."""
    if size is None or len(text) <= (size := max(size, LEAST_FRAGMENT)):
        return [text]
    total = math.ceil(len(text) / size)
    return [
        msgspec.json.encode(
            {
                "op": "fragment",
                "id": message_id,
                "data": text[num * size : (num + 1) * size],
                "num": num,
                "total": total,
            }
        ).decode()
        for num in range(total)
    ]


def partial_messages(limit: int) -> PartialMessages:
    """Return what holds the incomplete messages of one server, of at most `limit` bytes."""
    return PartialMessages(limit, FrameMemory(ByteBudget(sys.maxsize)))


class RosbridgeClientFraming(WebSocketFraming):
    """Text messages of WebSocket, one operation in each."""

    def __init__(self, peer: str, limit: int, handshake: ClientHandshake) -> None:
        """Accept messages of at most `limit` bytes."""
        super().__init__(peer, TextMessages(partial_messages(limit)), handshake)

    def feed(self, data: bytes) -> list[bytes]:
        is_new = self._handshake is not None
        frames = super().feed(data)
        return [OPENED, *frames] if is_new and self._handshake is None else frames

    def _message(self, frames: Sequence[bytes]) -> bytes:
        return b"".join(map(self._socket.send, filter(None, map(self._event, frames))))

    def _event(self, frame: bytes) -> Event | None:
        """Return what is sent for a frame; None for a sign that changes the close only."""
        if frame == INVALID:
            if self._messages.code == NORMAL:  # or the text itself was not one
                self._messages.code = websocket_frames.INVALID
            return None
        return Ping() if frame == PING else TextMessage(data=frame.decode())

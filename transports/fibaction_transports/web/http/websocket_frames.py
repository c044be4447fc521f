"""`WebSocketFraming`: frames of the wire protocol in binary messages of WebSocket.

Theory of operation
-------------------

The content of the binary messages, one after another, is the same stream of frames as over TCP:
each frame after its length, and one or several whole frames in a message. So what is ready at once
costs one message, whose overhead counts little, and what arrives goes piece by piece to the
`FrameReader`, with its limits and its count of memory: a message that is larger than the limit ends
the connection by its first bytes, however it is cut into pieces.

Both sides may use the framing at once: until the handshake is done, frames to send wait in it. What
WebSocket has to say by itself (the handshake, pongs) is the answer that the next `encode` returns.
Only the last of many pings gets a pong, which RFC 6455 permits, so a peer that sends pings and
reads nothing costs no memory.

The end: each side sends one close. `goodbye` returns ours, which may be the reply to the peer's;
otherwise the line waits for the peer's for a limited time. After an error of the peer the close has
the code that fits, and the reason is in the `Goodbye` before it.

The library is wsproto. The other one that fits, the sans-I/O layer of websockets, is two to three
times as fast with small messages, but returns a message only when all of it has arrived: its memory
could not be counted, nor could a frame over the limit be rejected at its length. Both are
maintained (2025-11, and 2026-10), neither has dependencies but h11, and this module and
`_handshake` are all that uses it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress

from wsproto.connection import Connection, ConnectionState, ConnectionType
from wsproto.events import BytesMessage, CloseConnection, Event, Ping, Pong, TextMessage
from wsproto.utilities import LocalProtocolError

from fibaction.border.peer_text import excerpt
from fibaction.wire.frames import FrameReader, Framing, framed
from fibaction.words.errors import ConnectionLost, LimitReached, ProtocolError
from fibaction_transports.web.http.handshake import ClientHandshake, ServerHandshake

NORMAL, UNSUPPORTED, INVALID, TOO_BIG, TRY_AGAIN = 1000, 1003, 1007, 1009, 1013
"""Codes of a close, of RFC 6455 and of its registry."""


class SocketMessages(ABC):
    """The messages of one peer, as frames; the WebSocket may be that of another server."""

    code = NORMAL
    """The code of our close: that of the error after a message that is wrong."""

    @abstractmethod
    def take(self, data: bytes | str, *, is_last: bool) -> list[bytes]:
        """Take a piece of a message, of bytes or text; return the frames that are complete.

        Raises:
            ProtocolError, LimitReached: It is wrong, or too large.
        """

    @property
    @abstractmethod
    def is_within_frame(self) -> bool:
        """True if a frame has arrived in part."""

    @abstractmethod
    def close(self) -> None:
        """Forget what is not complete."""


class BinaryMessages(SocketMessages):
    """Binary messages, which have the stream of frames of the wire protocol."""

    def __init__(self, reader: FrameReader) -> None:
        self._reader = reader

    def take(self, data: bytes | str, *, is_last: bool) -> list[bytes]:
        if isinstance(data, str):
            self.code = UNSUPPORTED
            raise ProtocolError("it sent a text message: the frames are in binary ones")
        try:
            frames = self._reader.feed(data)
        except ProtocolError:
            self.code = TOO_BIG
            raise
        except LimitReached:
            self.code = TRY_AGAIN
            raise
        if is_last and self._reader.is_within_frame:
            self.code = INVALID
            raise ProtocolError("a WebSocket message ended within a frame")
        return frames

    @property
    def is_within_frame(self) -> bool:
        return self._reader.is_within_frame

    def close(self) -> None:
        self._reader.close()


class WebSocketFraming(Framing):
    """Frames in messages of WebSocket, with the handshake before them."""

    def __init__(
        self, peer: str, messages: SocketMessages, handshake: ClientHandshake | ServerHandshake
    ) -> None:
        """Read frames in those messages; `peer` is for errors."""
        self._peer = peer
        self._messages = messages
        self._handshake: ClientHandshake | ServerHandshake | None = handshake
        self._is_server = isinstance(handshake, ServerHandshake)
        side = ConnectionType.SERVER if self._is_server else ConnectionType.CLIENT
        self._socket = Connection(side)
        self._waiting: list[bytes] = []  # frames, until the handshake is done
        self._answer = handshake.answer
        self._pong: Event | None = None
        self._is_broken = False
        self._lost = ""  # why the peer has closed
        self._reply: Event | None = None  # to the close of the peer

    @property
    def has_answer(self) -> bool:  # type: ignore[override]  # here it changes
        """True if there are bytes to send that belong to no frame."""
        return bool(self._answer) or self._pong is not None

    @property
    def has_ended(self) -> bool:  # type: ignore[override]  # here it changes
        """True if the peer has closed."""
        return bool(self._lost)

    @property
    def is_closed(self) -> bool:  # type: ignore[override]  # here it changes
        """True if nothing more is expected of the peer."""
        if self._handshake is not None:
            return not self._is_server  # a client closes when it has read the answer
        return self._socket.state is ConnectionState.CLOSED and not self._is_broken

    @property
    def ends_stream(self) -> bool:  # type: ignore[override]  # here it changes
        """True if nothing that the peer may still say can be read."""
        return self._is_server and (self._handshake is not None or self._is_broken)

    @property
    def is_within_frame(self) -> bool:
        return self._messages.is_within_frame

    def feed(self, data: bytes) -> list[bytes]:
        self.check()
        if self._handshake is not None:
            rest = self._shake_hands(self._handshake, data)
            if not rest:
                return []
            data = rest
        try:
            return self._read(data)
        except (ProtocolError, LimitReached):
            self._is_broken = True
            raise

    def _shake_hands(
        self, handshake: ClientHandshake | ServerHandshake, data: bytes
    ) -> bytes | None:
        try:
            rest = handshake.feed(data)
        finally:
            if self._is_server:
                self._answer = handshake.answer
        if rest is None:
            return None
        self._handshake = None
        if self._waiting:
            waiting, self._waiting = self._waiting, []
            self._answer += self._message(waiting)
        return rest

    def _read(self, received: bytes) -> list[bytes]:
        frames: list[bytes] = []
        self._socket.receive_data(received)
        for event in self._socket.events():
            if isinstance(event, BytesMessage | TextMessage):
                data = event.data if isinstance(event, TextMessage) else bytes(event.data)
                frames += self._messages.take(data, is_last=event.message_finished)
            elif isinstance(event, Pong):
                frames += self._take_pong()
            elif isinstance(event, Ping):
                self._pong = event.response()
            else:
                assert isinstance(event, CloseConnection)
                self._end(event)
                if not frames:
                    self.check()
                break  # nothing counts behind it
        return frames

    def _take_pong(self) -> list[bytes]:
        """Return the frames that a pong stands for."""
        return []

    def _end(self, event: CloseConnection) -> None:
        """Note that the peer has closed, or that what it has sent is not WebSocket."""
        reason = excerpt(event.reason or "")
        if self._socket.state is ConnectionState.OPEN:
            self._messages.code = int(event.code)
            raise ProtocolError(f"invalid WebSocket data: {reason}")
        self._reply = event.response()
        self._lost = f"{self._peer} closed: {event.code} {reason}".rstrip()

    def check(self) -> None:
        if self._lost:
            raise ConnectionLost(self._lost)

    def encode(self, frames: Sequence[bytes]) -> bytes:
        if self._handshake is not None:
            self._waiting += frames
            return self._take_answer()
        if not frames or self._socket.state is not ConnectionState.OPEN:
            return self._take_answer()
        if not self.has_answer:
            return self._message(frames)
        return self._take_answer() + self._message(frames)

    def _message(self, frames: Sequence[bytes]) -> bytes:
        return self._socket.send(BytesMessage(data=framed(frames)))

    def _take_answer(self) -> bytes:
        answer, self._answer = self._answer, b""
        if self._pong is not None:
            pong, self._pong = self._pong, None
            if self._socket.state is ConnectionState.OPEN:
                answer += self._socket.send(pong)
        return answer

    def goodbye(self) -> bytes:
        handshake = self._handshake
        if handshake is not None:
            if self._is_server and not handshake.answer:
                return handshake.give_up(self._waiting)
            return self._take_answer()
        last = self._take_answer()
        if self._reply is not None:
            reply, self._reply = self._reply, None
            last += self._socket.send(reply)
        elif self._socket.state is ConnectionState.OPEN:
            code, reason = self._closing()
            last += self._socket.send(CloseConnection(code=code, reason=reason))
        return last

    def _closing(self) -> tuple[int, str | None]:
        """Return the code and the reason of our close."""
        return self._messages.code, None

    def discard(self, data: bytes) -> None:
        if self._handshake is None and not self._is_broken and not self.is_closed:
            with suppress(LocalProtocolError):
                self._socket.receive_data(data)
            for _ in self._socket.events():
                pass

    def close(self) -> None:
        self._messages.close()

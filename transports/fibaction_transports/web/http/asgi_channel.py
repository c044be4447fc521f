"""`AsgiChannel`: frames of the wire protocol in binary messages of WebSocket, over ASGI.

The server of the application assembles the messages, so its own limit is the one that counts before
a message is here: 16 MiB with uvicorn and hypercorn.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import anyio

from fibaction.border.peer_text import excerpt
from fibaction.wire.channel import LEAVE, Channel
from fibaction.wire.frames import FrameReader, framed
from fibaction.words.errors import ConnectionLost, LimitReached, ProtocolError
from fibaction_transports._http.exchange import Receive, Send

NORMAL, UNSUPPORTED, INVALID, TOO_BIG, TRY_AGAIN = 1000, 1003, 1007, 1009, 1013
"""Codes of a close, of RFC 6455."""


class AsgiChannel(Channel):
    """One connection that an ASGI server has accepted."""

    def __init__(self, receive: Receive, send: Send, peer: str, reader: FrameReader) -> None:
        self.peer = peer
        self._receive = receive
        self._send = send
        self._reader = reader
        self._code = NORMAL
        self._is_lost = False

    async def send(self, frames: Sequence[bytes]) -> None:
        try:
            await self._send({"type": "websocket.send", "bytes": framed(frames)})
        except (OSError, RuntimeError) as exc:  # servers differ in it
            raise self._lost(f"the connection to {self.peer} broke") from exc

    async def receive(self) -> list[bytes]:
        message = await self._receive()
        if message["type"] == "websocket.disconnect":
            reason = excerpt(message.get("reason") or "")
            raise self._lost(f"{self.peer} closed: {message.get('code', '')} {reason}".rstrip())
        data = message.get("bytes")
        if data is None:
            self._code = UNSUPPORTED
            raise ProtocolError("it sent a text message: the frames are in binary ones")
        try:
            frames = self._reader.feed(data)
        except ProtocolError:
            self._code = TOO_BIG
            raise
        except LimitReached:
            self._code = TRY_AGAIN
            raise
        if self._reader.is_within_frame:
            self._code = INVALID
            raise ProtocolError("a WebSocket message ended within a frame")
        return frames

    def _lost(self, text: str) -> ConnectionLost:
        self._is_lost = True
        return ConnectionLost(text)

    async def aclose(self) -> None:
        self._reader.close()
        if not self._is_lost:
            with anyio.move_on_after(LEAVE, shield=True), suppress(OSError, RuntimeError):
                await self._send({"type": "websocket.close", "code": self._code})

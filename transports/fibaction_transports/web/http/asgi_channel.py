"""`AsgiChannel`: frames in messages of WebSocket, over ASGI.

The server of the application assembles the messages, so its own limit is the one that counts before
a message is here: 16 MiB with uvicorn and hypercorn.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import anyio

from fibaction.border.peer_text import excerpt
from fibaction.wire.channel import LEAVE, Channel
from fibaction.wire.frames import framed
from fibaction.words.errors import ConnectionLost
from fibaction_transports._http.exchange import Receive, Send
from fibaction_transports.web.http.websocket_frames import SocketMessages


class AsgiChannel(Channel):
    """One connection that an ASGI server has accepted."""

    def __init__(self, receive: Receive, send: Send, peer: str, messages: SocketMessages) -> None:
        self.peer = peer
        self._receive = receive
        self._send = send
        self._messages = messages
        self._is_lost = False

    async def send(self, frames: Sequence[bytes]) -> None:
        await self._write(bytes=framed(frames))

    async def _write(self, **message: bytes | str) -> None:
        try:
            await self._send({"type": "websocket.send", **message})
        except (OSError, RuntimeError) as exc:  # servers differ in it
            self._is_lost = True
            raise ConnectionLost(f"the connection to {self.peer} broke") from exc

    async def receive(self) -> list[bytes]:
        message = await self._receive()
        if message["type"] == "websocket.disconnect":
            self._is_lost = True
            reason = excerpt(message.get("reason") or "")
            code = message.get("code", "")
            raise ConnectionLost(f"{self.peer} closed: {code} {reason}".rstrip())
        data = message.get("bytes")
        text = message.get("text") or ""
        return self._messages.take(text if data is None else data, is_last=True)

    def _closing(self) -> tuple[int, str]:
        """Return the code and the reason of our close."""
        return self._messages.code, ""

    async def aclose(self) -> None:
        self._messages.close()
        if not self._is_lost:
            code, reason = self._closing()
            close = {"type": "websocket.close", "code": code, "reason": reason}
            with anyio.move_on_after(LEAVE, shield=True), suppress(OSError, RuntimeError):
                await self._send(close)

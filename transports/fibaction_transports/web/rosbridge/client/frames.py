"""`RosbridgeClientFraming`: messages of rosbridge over WebSocket, for a client.

A frame is the text of one message. Three frames are signs: `OPENED` is received first, once the
server has accepted the WebSocket; `PING` is sent as a ping; `INVALID` is sent last, after a message
of the server that cannot be read, and goes into the code of the close.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from wsproto.events import Event, Ping, TextMessage

from fibaction.border.byte_budgets import ByteBudget
from fibaction.wire.frames import FrameMemory
from fibaction.wire.link import PING
from fibaction_transports.web.http import websocket_frames
from fibaction_transports.web.http.handshake import ClientHandshake
from fibaction_transports.web.http.websocket_frames import NORMAL, WebSocketFraming
from fibaction_transports.web.rosbridge.fragments import PartialMessages, TextMessages

OPENED = b""
"""The frame that says that the server has accepted the WebSocket."""
INVALID = b"\0"
"""The frame that says that a message of the server is invalid. It is not JSON, as messages are."""


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

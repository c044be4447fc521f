"""`RosbridgeFraming`: messages of rosbridge over WebSocket, as the frames of a session."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from wsproto.connection import ConnectionState
from wsproto.events import Ping, TextMessage

from fibaction.wire.link import PING
from fibaction.wire.messages import Goodbye, Why
from fibaction.words.errors import LimitReached, ProtocolError
from fibaction_transports.web.http.handshake import ServerHandshake
from fibaction_transports.web.http.websocket_frames import (
    INVALID,
    NORMAL,
    TRY_AGAIN,
    WebSocketFraming,
)
from fibaction_transports.web.rosbridge.fragments import TextMessages
from fibaction_transports.web.rosbridge.server.translator import RosbridgeTranslator

AWAY, PROTOCOL, FORBIDDEN, FAILED = 1001, 1002, 1008, 1011
"""Codes of a close, of RFC 6455."""
LONGEST_REASON = 123
"""Bytes of the reason of a close, at most."""

_CODES = {
    0: AWAY,
    Why.FORBIDDEN: FORBIDDEN,
    Why.LIMIT: TRY_AGAIN,
    Why.PROTOCOL: PROTOCOL,
    Why.CONNECTION_LOST: AWAY,
}


def closing(goodbye: Goodbye | None, found: int) -> tuple[int, str]:
    """Return the code and the reason of a close after a goodbye, or without one.

    `found` is the code of what was wrong with a message; 1000 if nothing was.
    """
    if goodbye is None:
        return found, ""
    reason = goodbye.reason.encode("utf-8", "replace")[:LONGEST_REASON].decode("utf-8", "ignore")
    if found != NORMAL and goodbye.why == Why.PROTOCOL:
        return found, reason
    return _CODES.get(goodbye.why, FAILED), reason


class WaitingTexts(TextMessages):
    """The messages of a client, which wait until they are translated."""

    def __init__(self, translator: RosbridgeTranslator) -> None:
        super().__init__(translator.messages)
        self._translator = translator
        self._texts: deque[str] = deque()

    def frames_of(self, text: str) -> list[bytes]:
        self._texts.append(text)
        return []

    @property
    def is_empty(self) -> bool:
        """True if no message waits."""
        return not self._texts

    async def translated(self) -> list[bytes]:
        """Return the frames that the messages are which have arrived, in their order.

        Raises:
            ProtocolError, LimitReached: As `RosbridgeTranslator.frames_of`.
        """
        frames: list[bytes] = []
        try:
            while self._texts:
                frames += await self._translator.frames_of(self._texts[0])
                self._texts.popleft()
        except (ProtocolError, LimitReached):
            self.code = INVALID
            raise
        return frames


class RosbridgeFraming(WebSocketFraming):
    """Messages of rosbridge, both ways."""

    def __init__(self, handshake: ServerHandshake, translator: RosbridgeTranslator) -> None:
        self.texts = WaitingTexts(translator)
        super().__init__("the client", self.texts, handshake)
        self.translator = translator

    @property
    def has_answer(self) -> bool:  # type: ignore[override]  # here it changes
        """True if there are bytes to send that belong to no frame."""
        return super().has_answer or self.translator.has_texts

    def begin(self) -> list[bytes]:
        """Return the hello for the session, once the handshake is done and was answered."""
        return self.translator.begin() if self._handshake is None else []

    def check(self) -> None:
        if self.texts.is_empty:
            super().check()

    async def translated(self) -> list[bytes]:
        """See `WaitingTexts.translated`."""
        try:
            return await self.texts.translated()
        except (ProtocolError, LimitReached):
            self._is_broken = True
            raise

    def _take_pong(self) -> list[bytes]:
        return self.translator.is_alive()

    def _message(self, frames: Sequence[bytes]) -> bytes:
        events: list[TextMessage | Ping] = []
        for frame in frames:
            if frame == PING:
                events.append(Ping())
            else:
                events += [TextMessage(data=text) for text in self.translator.texts_of(frame)]
        return b"".join(map(self._socket.send, events))

    def _closing(self) -> tuple[int, str | None]:
        return closing(self.translator.goodbye, self.texts.code)

    def _take_answer(self) -> bytes:
        answer = super()._take_answer()
        if self._handshake is None and self._socket.state is ConnectionState.OPEN:
            texts = self.translator.take_texts()
            answer += b"".join(self._socket.send(TextMessage(data=text)) for text in texts)
        return answer

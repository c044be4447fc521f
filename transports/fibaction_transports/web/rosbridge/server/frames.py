"""`RosbridgeFraming`: messages of rosbridge over WebSocket, as the frames of a session."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from wsproto.connection import ConnectionState
from wsproto.events import BytesMessage, Ping, TextMessage
from wsproto.frame_protocol import CloseReason

from fibaction.wire.link import PING
from fibaction.wire.wire_server import WireServer
from fibaction.words.errors import LimitReached, ProtocolError
from fibaction_transports.web.http.handshake import ServerHandshake
from fibaction_transports.web.http.websocket_frames import WebSocketFraming
from fibaction_transports.web.rosbridge.close_codes import (
    BINARY,
    LONGEST_REASON,
    close_code,
    shortened_bytes,
)
from fibaction_transports.web.rosbridge.server.translator import RosbridgeTranslator


class RosbridgeFraming(WebSocketFraming):
    """Text messages of WebSocket, one operation in each."""

    def __init__(
        self, server: WireServer, handshake: ServerHandshake, translator: RosbridgeTranslator
    ) -> None:
        super().__init__("the client", server.new_reader(), handshake)
        self.translator = translator
        self._texts: deque[str] = deque()

    @property
    def has_answer(self) -> bool:  # type: ignore[override]  # here it changes
        """True if there are bytes to send that belong to no frame."""
        return super().has_answer or self.translator.has_texts

    @property
    def is_within_frame(self) -> bool:
        return not self.translator.messages.is_empty

    def begin(self) -> list[bytes]:
        """Return the hello for the session, once the handshake is done and was answered."""
        return self.translator.begin() if self._handshake is None else []

    def _take(self, event: BytesMessage) -> list[bytes]:
        self._code = CloseReason.UNSUPPORTED_DATA
        raise ProtocolError(BINARY)

    def _take_text(self, event: TextMessage) -> list[bytes]:
        messages = self.translator.messages
        self._code = CloseReason.MESSAGE_TOO_BIG
        text = messages.add_piece(event.data, is_last=event.message_finished)
        self._code = CloseReason.NORMAL_CLOSURE
        if text is not None:
            self._texts.append(text)
        return []

    def check(self) -> None:
        if not self._texts:
            super().check()

    async def translated(self) -> list[bytes]:
        """Return the frames that the messages are which have arrived, in their order.

        Raises:
            ProtocolError, LimitReached: As `RosbridgeTranslator.frames_of`.
        """
        frames: list[bytes] = []
        try:
            while self._texts:
                frames += await self.translator.frames_of(self._texts[0])
                self._texts.popleft()
        except (ProtocolError, LimitReached):
            self._code = CloseReason.INVALID_FRAME_PAYLOAD_DATA
            self._is_broken = True
            raise
        return frames

    def _take_pong(self) -> list[bytes]:
        return self.translator.is_alive()

    def _message(self, frames: Sequence[bytes]) -> bytes:
        events: list[TextMessage | Ping] = []
        for frame in frames:
            if frame == PING:
                events.append(Ping())
            else:
                events += [TextMessage(data=text) for text in self.translator.texts_of(frame)]
        self._note_goodbye()
        return b"".join(map(self._socket.send, events))

    def _note_goodbye(self) -> None:
        goodbye = self.translator.goodbye
        if goodbye is not None:
            self._code = CloseReason(close_code(goodbye, self._code))
            self._reason = shortened_bytes(goodbye.reason, LONGEST_REASON)

    def _take_answer(self) -> bytes:
        answer = super()._take_answer()
        if self._handshake is None and self._socket.state is ConnectionState.OPEN:
            texts = self.translator.take_texts()
            answer += b"".join(self._socket.send(TextMessage(data=text)) for text in texts)
        return answer

    def close(self) -> None:
        super().close()
        self.translator.messages.close()

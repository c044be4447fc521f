"""`RosbridgeGuest`: its frames of a session, and its channels, over a stream and over ASGI."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence

from anyio.abc import ByteStream
from wsproto.connection import ConnectionState
from wsproto.events import Ping, TextMessage

from fibaction.border.event_loop import Background
from fibaction.border.http_access import HttpRules, bearer_in
from fibaction.border.peer_text import clean_logger
from fibaction.wire.channel import Channel, NextFrames, OnFrames, StreamChannel
from fibaction.wire.link import PING
from fibaction.wire.messages import Goodbye, Why
from fibaction.wire.wire_server import WireServer
from fibaction.words.errors import LimitReached, ProtocolError
from fibaction.words.goals import GoalID
from fibaction_transports._http.exchange import Receive, Send
from fibaction_transports.web.http.application import AsgiChannel, SocketGuest
from fibaction_transports.web.http.handshake import ServerHandshake
from fibaction_transports.web.http.websocket_frames import (
    INVALID,
    NORMAL,
    TRY_AGAIN,
    WebSocketFraming,
)
from fibaction_transports.web.rosbridge.server.translator import RosbridgeTranslator
from fibaction_transports.web.rosbridge.text_messages import TextMessages

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
logger = clean_logger("fibaction.web")


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


class _RosbridgeChannel(Channel):
    """A channel that gives the session the replies of its translator."""

    holds_briefly = True
    translator: RosbridgeTranslator
    _handle: OnFrames | None = None

    async def run(self, on_frames: OnFrames, next_frames: NextFrames) -> None:
        self._handle = on_frames
        await super().run(on_frames, next_frames)

    def _reply(self, frames: list[bytes]) -> None:
        """Give the session these frames, and those about what was written."""
        frames = frames + self.translator.take_replies()
        while frames and self._handle is not None:
            frames = self._handle(frames)


class RosbridgeStreamChannel(StreamChannel, _RosbridgeChannel):
    """rosbridge over a stream of bytes."""

    def __init__(self, stream: ByteStream, peer: str, framing: RosbridgeFraming) -> None:
        super().__init__(stream, peer, framing)
        self.translator = framing.translator
        self._messages = framing

    async def send(self, frames: Sequence[bytes]) -> None:
        await super().send(frames)
        self._reply(self._messages.begin())

    async def receive(self) -> list[bytes]:
        frames = await super().receive()
        frames += await self._messages.translated()
        if self.has_answer:
            self.wake_writer()
        return frames


class RosbridgeAsgiChannel(AsgiChannel, _RosbridgeChannel):
    """rosbridge over ASGI, whose server watches the line itself: the client counts as alive."""

    def __init__(
        self, receive: Receive, send: Send, peer: str, translator: RosbridgeTranslator
    ) -> None:
        self.translator = translator
        self._texts = WaitingTexts(translator)
        super().__init__(receive, send, peer, self._texts)

    @property
    def has_answer(self) -> bool:  # type: ignore[override]  # here it changes
        """True if `send` is to be called even without frames: for answers that belong to none."""
        return self.translator.has_texts

    async def send(self, frames: Sequence[bytes]) -> None:
        for frame in frames:
            if frame != PING:
                await self._send_texts(self.translator.texts_of(frame))
        await self._send_texts(self.translator.take_texts())
        self._reply(self.translator.is_alive() if PING in frames else [])

    async def _send_texts(self, texts: list[str]) -> None:
        for text in texts:
            await self._write(text=text)

    async def receive(self) -> list[bytes]:
        if hello := self.translator.begin():
            return hello
        await super().receive()
        frames = await self._texts.translated()
        if self.has_answer:
            self.wake_writer()
        return frames

    def _closing(self) -> tuple[int, str]:
        return closing(self.translator.goodbye, self._texts.code)


class RosbridgeGuest(SocketGuest):
    """rosbridge at a server of HTTP."""

    async def serve_stream(
        self,
        server: WireServer,
        stream: ByteStream,
        peer: str,
        headers: Mapping[str, str],
        rules: HttpRules,
    ) -> None:
        handshake = ServerHandshake(rules, subprotocol="")
        framing = RosbridgeFraming(handshake, _new_translator(server, peer, headers))
        await _serve(server, RosbridgeStreamChannel(stream, peer, framing))

    async def serve_asgi(
        self,
        server: WireServer,
        receive: Receive,
        send: Send,
        peer: str,
        headers: Mapping[str, str],
    ) -> None:
        translator = _new_translator(server, peer, headers)
        await _serve(server, RosbridgeAsgiChannel(receive, send, peer, translator))


def _new_translator(
    server: WireServer, peer: str, headers: Mapping[str, str]
) -> RosbridgeTranslator:
    """Return the translator of a new connection, by the headers of its request."""
    token = bearer_in(headers)
    return RosbridgeTranslator(peer, server.endpoints, server.settings, server.frames, token)


async def _serve(
    server: WireServer, channel: RosbridgeStreamChannel | RosbridgeAsgiChannel
) -> None:
    """Serve one client until its connection ends."""
    async with Background() as tasks:
        tasks.start_soon(channel.translator.topics.run, channel.wake_writer)
        await server.serve(channel)
    # A client cannot come back to its goals: a new connection does not know them.
    if bound := channel.translator.calls.bound_goals():
        server.tasks.start_soon(_cancel, server, channel.peer, bound)


async def _cancel(server: WireServer, peer: str, bound: list[tuple[str, GoalID]]) -> None:
    """Cancel the goals of a client whose connection is lost."""
    logger.info("%s is gone: canceling its goals with cancel_on_disconnect: %d", peer, len(bound))
    for action, goal_id in bound:
        try:
            await server.endpoints[action].cancel_goals(goal_id)
        except Exception as exc:  # an endpoint may be foreign code, or gone
            logger.warning("goal %s could not be canceled: %s", goal_id, exc)

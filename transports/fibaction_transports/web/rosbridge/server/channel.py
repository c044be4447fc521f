"""`RosbridgeGuest`, and the channels of its two forms: over a stream, and over ASGI."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from anyio.abc import ByteStream

from fibaction.border.event_loop import Background
from fibaction.border.http_access import HttpRules, bearer_in
from fibaction.border.peer_text import clean_logger
from fibaction.wire.channel import Channel, NextFrames, OnFrames, StreamChannel
from fibaction.wire.link import PING
from fibaction.wire.wire_server import WireServer
from fibaction.words.goals import GoalID
from fibaction_transports._http.exchange import Receive, Send
from fibaction_transports.web.http.application import SocketGuest
from fibaction_transports.web.http.asgi_channel import AsgiChannel
from fibaction_transports.web.http.handshake import ServerHandshake
from fibaction_transports.web.rosbridge.server.frames import RosbridgeFraming, WaitingTexts, closing
from fibaction_transports.web.rosbridge.server.translator import RosbridgeTranslator

logger = clean_logger("fibaction.web")


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

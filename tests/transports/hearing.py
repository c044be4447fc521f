"""What the tests of connections share: to wait for a line of the log, and to speak to a server
without a client.
"""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator, Generator
from contextlib import asynccontextmanager, contextmanager, suppress

import anyio
from anyio.abc import SocketAttribute, SocketStream
from wsproto.events import BytesMessage

from fibaction._runtime.notify import Notifier
from fibaction.wire.frames import FrameReader, Framing
from fibaction.wire.messages import FromServer, decode_from_server
from fibaction.words.errors import ConnectionLost
from fibaction_transports.web.http.handshake import ClientHandshake
from fibaction_transports.web.http.websocket_frames import BinaryMessages, WebSocketFraming


class Hearing(logging.Handler):
    """Keeps what a logger says, and lets a test wait for it."""

    def __init__(self) -> None:
        super().__init__(logging.DEBUG)
        self.records: list[logging.LogRecord] = []
        self._news = Notifier()

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(record)
        self._news.notify()

    @property
    def warnings(self) -> list[str]:
        return [one.getMessage() for one in self.records if one.levelno >= logging.WARNING]

    async def until(self, text: str) -> logging.LogRecord:
        """Wait for a line that has the text in it."""
        with anyio.fail_after(30):
            while True:
                for record in self.records:
                    if text in record.getMessage():
                        return record
                await self._news.wait()

    async def told(self, text: str, count: int) -> None:
        """Wait until so many lines have the text in them."""
        with anyio.fail_after(15):
            while sum(text in record.getMessage() for record in self.records) < count:
                await self._news.wait()

    async def lines(self, count: int) -> None:
        """Wait until there are so many lines."""
        with anyio.fail_after(30):
            while len(self.records) < count:
                await self._news.wait()


@contextmanager
def hearing(name: str = "fibaction.wire") -> Generator[Hearing, None, None]:
    logger, handler = logging.getLogger(name), Hearing()
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)
    try:
        yield handler
    finally:
        logger.setLevel(before)
        logger.removeHandler(handler)


class Raw:
    """A peer that says whatever the test wants, over TCP or WebSocket."""

    def __init__(self, stream: SocketStream, framing: Framing) -> None:
        self.name = f"127.0.0.1:{stream.extra(SocketAttribute.local_port)}"
        """As the server's log calls it."""
        self.stream = stream
        self._framing = framing
        self._messages: list[FromServer] = []

    async def shake_hands(self) -> None:
        """Do what comes before the first frame, if anything does."""
        with anyio.fail_after(30):
            while self._framing.has_answer:
                await self.stream.send(self._framing.encode([]))
                self._framing.feed(await self.stream.receive())

    async def say(self, *frames: bytes) -> None:
        await self.stream.send(self._framing.encode(frames))

    async def send(self, data: bytes) -> None:
        """Send bytes where frames are expected: over WebSocket in a message that goes on."""
        if isinstance(self._framing, WebSocketFraming):
            event = BytesMessage(data=data, message_finished=False)
            data = self._framing._socket.send(event)
        await self.stream.send(data)

    async def hear(self) -> FromServer:
        """The next message."""
        with anyio.fail_after(30):
            while not self._messages:
                await self._receive()
            return self._messages.pop(0)

    async def hear_all(self) -> list[FromServer]:
        """All messages until the server closes."""
        with anyio.fail_after(30):
            try:
                while True:
                    await self._receive()
            except (anyio.EndOfStream, anyio.BrokenResourceError):
                return self._messages
            except ConnectionLost:  # WebSocket's close, which the server expects to be answered
                with suppress(anyio.BrokenResourceError):
                    await self.stream.send(self._framing.goodbye())
                return self._messages

    async def _receive(self) -> None:
        data = await self.stream.receive()
        self._messages += map(decode_from_server, self._framing.feed(data))
        self._framing.check()


@asynccontextmanager
async def raw(url: str) -> AsyncGenerator[Raw, None]:
    async with await anyio.connect_tcp("127.0.0.1", port_of(url)) as stream:
        framing: Framing = FrameReader()
        if url.startswith("ws:"):
            handshake = ClientHandshake(url.removeprefix("ws://"), "/")
            framing = WebSocketFraming("the server", BinaryMessages(FrameReader()), handshake)
        peer = Raw(stream, framing)
        await peer.shake_hands()
        yield peer


def port_of(url: str) -> int:
    return int(url.rpartition(":")[2])

"""What the tests of connections share: to wait for a line of the log, and to speak to a server
without a client.
"""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator, Generator
from contextlib import asynccontextmanager, contextmanager

import anyio
from anyio.abc import SocketAttribute, SocketStream

from fibaction._notify import Notifier
from fibaction.wire.codec import FromServer, decode_from_server
from fibaction.wire.frames import FrameReader, header


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
        with anyio.fail_after(5):
            while True:
                for record in self.records:
                    if text in record.getMessage():
                        return record
                await self._news.wait()

    async def lines(self, count: int) -> None:
        """Wait until there are so many lines."""
        with anyio.fail_after(5):
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
    """A peer that says whatever the test wants."""

    def __init__(self, stream: SocketStream) -> None:
        self.name = f"127.0.0.1:{stream.extra(SocketAttribute.local_port)}"
        """As the server's log calls it."""
        self.stream = stream
        self._reader = FrameReader()
        self._messages: list[FromServer] = []

    async def say(self, *frames: bytes) -> None:
        await self.stream.send(b"".join(header(len(frame)) + frame for frame in frames))

    async def hear(self) -> FromServer:
        """The next message."""
        with anyio.fail_after(5):
            while not self._messages:
                data = await self.stream.receive()
                self._messages += map(decode_from_server, self._reader.feed(data))
            return self._messages.pop(0)

    async def hear_all(self) -> list[FromServer]:
        """All messages until the server closes."""
        with anyio.fail_after(5):
            try:
                while True:
                    data = await self.stream.receive()
                    self._messages += map(decode_from_server, self._reader.feed(data))
            except (anyio.EndOfStream, anyio.BrokenResourceError):
                return self._messages


@asynccontextmanager
async def raw(url: str) -> AsyncGenerator[Raw, None]:
    async with await anyio.connect_tcp("127.0.0.1", port_of(url)) as stream:
        yield Raw(stream)


def port_of(url: str) -> int:
    return int(url.rpartition(":")[2])

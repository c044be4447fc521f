"""A hostile client: raw frames over a socket, and none of the rules of the client library."""

from __future__ import annotations

import socket
import struct
from collections import Counter, deque
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import asynccontextmanager, suppress
from itertools import count
from typing import Any, TypeVar

import anyio
import msgspec
from anyio.abc import SocketAttribute, SocketStream

from fibaction._runtime.notify import Notifier
from fibaction.wire.frames import FrameReader, framed
from fibaction.wire.messages import VERSION, Actions, Hello, ListActions, decode_from_server, encode

T = TypeVar("T")

KEPT = {1, 32, 33, 34, 35, 38, 39, 41, 42, 43, 44, 45, 46}
"""Tags of the messages that are kept to be heard: all but feedback, changes and heartbeats."""
LONG_ARRAY = 0xDC
"""First byte of a message of 16 fields or more, with its tag; two bytes of its length follow."""
SOON = 20.0
"""Seconds for an answer: many times what the slowest takes on a busy machine."""

Lost = (
    OSError,
    anyio.EndOfStream,
    anyio.BrokenResourceError,
    anyio.ClosedResourceError,
    ConnectionError,
)
"""Errors of a connection that the server has closed."""


def packed(*messages: object) -> bytes:
    """Return messages as the bytes that are sent."""
    return framed(map(encode, messages))


async def until(condition: Callable[[], bool]) -> None:
    """Wait for a condition whose change is not notified, such as the number of goals so far."""
    while not condition():  # noqa: ASYNC110  # see above
        await anyio.sleep(0.005)


class Raw:
    """One connection. What arrives is counted by its tag; answers are kept to be heard."""

    def __init__(self, stream: SocketStream) -> None:
        self.ids: Iterator[int] = count(1)
        self.counts: Counter[int] = Counter()
        self.is_open = True
        self._stream = stream
        self._heard: deque[Any] = deque(maxlen=20_000)
        self._news = Notifier()

    async def write(self, data: bytes) -> None:
        """Send bytes as they are."""
        await self._stream.send(data)

    async def say(self, *messages: object) -> None:
        """Send messages."""
        await self.write(packed(*messages))

    async def read(self) -> None:
        """Read until the connection ends."""
        reader = FrameReader(2**32 - 1)
        try:
            while True:
                for frame in reader.feed(await self._stream.receive(2**18)):
                    tag = frame[3 if frame[0] == LONG_ARRAY else 1]
                    self.counts[tag] += 1
                    if tag in KEPT:
                        self._heard.append(decode_from_server(frame))
                        self._news.notify()
        except Lost:
            self.is_open = False
            self._news.notify()

    async def hear(self, kind: type[T], id: int | None = None, within: float = SOON) -> T:
        """Return the next message of a kind; leave out those before.

        Raises:
            ConnectionError: The connection has ended before.
        """
        with anyio.fail_after(within):
            while True:
                while self._heard:
                    message = self._heard.popleft()
                    if isinstance(message, kind) and id in (None, getattr(message, "id", None)):
                        return message
                if not self.is_open:
                    raise ConnectionError("the server has closed the connection")
                await self._news.wait()

    async def answer(self, id: int, within: float = SOON) -> Any:
        """Return the next message of that ID.

        Raises:
            ConnectionError: The connection has ended before.
        """
        return await self.hear(object, id, within)

    async def count(self, kind: type[msgspec.Struct], times: int, within: float = SOON) -> None:
        """Wait until so many messages of a kind have arrived.

        Raises:
            ConnectionError: The connection has ended before.
        """
        tag = kind.__struct_config__.tag
        assert isinstance(tag, int)
        with anyio.fail_after(within):
            while self.counts[tag] < times:
                if not self.is_open:
                    raise ConnectionError("the server has closed the connection")
                if tag in KEPT:
                    await self._news.wait()
                else:
                    await anyio.sleep(0.01)

    async def fence(self, within: float = SOON) -> None:
        """Wait until the server has handled what was sent before."""
        with anyio.fail_after(within):
            while True:
                number = next(self.ids) + 2**40
                await self.say(ListActions(number))
                if isinstance(await self.answer(number), Actions):
                    return
                await anyio.sleep(0.02)  # too many requests at once

    async def ended(self, within: float = SOON) -> None:
        """Wait until the server has closed the connection."""
        with anyio.fail_after(within):
            while self.is_open:
                await self._news.wait()

    async def close_half(self) -> None:
        """Close the direction to the server, and read on."""
        await self._stream.send_eof()

    async def reset(self) -> None:
        """End the connection with a reset, in the middle of whatever it is."""
        raw = self._stream.extra(SocketAttribute.raw_socket)
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        await self._stream.aclose()


class Target:
    """The server that is attacked, and the attacker's name there."""

    def __init__(self, url: str, token: str = "", *, web: str = "", is_long: bool = False) -> None:
        """Attack the server at `url`, and its door for the web at `web`."""
        self.web = web
        host, _, port = url.partition("://")[2].rpartition(":")
        self.is_long = is_long
        self.host, self.port = host, int(port)
        self.token = token

    def size(self, short: int, long: int) -> int:
        """Return the size of something in the short form of an attack, and in the long one."""
        return long if self.is_long else short

    def hello(self, **fields: Any) -> Hello:
        """Return the attacker's first message."""
        return Hello(**{"version": VERSION, "heartbeat": 60.0, "token": self.token, **fields})

    @asynccontextmanager
    async def dial(
        self, *, hello: bool = True, reads: bool = True, **fields: Any
    ) -> AsyncGenerator[Raw, None]:
        """Open a connection; a task reads it, if `reads`."""
        async with await anyio.connect_tcp(self.host, self.port) as stream:
            raw = Raw(stream)
            try:
                async with anyio.create_task_group() as tasks:
                    if reads:
                        tasks.start_soon(raw.read)
                    if hello:
                        await raw.say(self.hello(**fields))
                    yield raw
                    tasks.cancel_scope.cancel()
            except BaseExceptionGroup as group:
                raise group.exceptions[0] from None  # as if there was no task

    @asynccontextmanager
    async def dial_many(self, count: int, **how: Any) -> AsyncGenerator[list[Raw], None]:
        """Open connections, but for those that the server closes at once.

        Raises:
            ConnectionError: It has closed all of them.
        """
        async with anyio.create_task_group() as tasks:
            opened: list[Raw] = []
            tried: set[int] = set()
            done = anyio.Event()

            async def one(number: int) -> None:
                try:
                    async with self.dial(**how) as raw:
                        opened.append(raw)
                        tried.add(number)
                        await done.wait()
                except Lost:
                    tried.add(number)

            for number in range(count):
                tasks.start_soon(one, number)
            await until(lambda: len(tried) == count)
            if not opened:
                raise ConnectionError("the server accepts no connection")
            try:
                yield opened
            finally:
                done.set()


async def each(raws: list[Raw], work: Callable[[Raw], Any]) -> None:
    """Do the same on each connection, at the same time, as long as the server does not close it."""

    async def one(raw: Raw) -> None:
        with suppress(*Lost):
            await work(raw)

    async with anyio.create_task_group() as tasks:
        for raw in raws:
            tasks.start_soon(one, raw)

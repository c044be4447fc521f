"""A connection in memory that can be spoiled, and a peer who says what a test tells it to."""

from __future__ import annotations

import asyncio  # noqa: TID251  # it alone can cancel a task without a scope
import logging
from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import AbstractAsyncContextManager, contextmanager
from types import TracebackType
from typing import Any, Generic, TypeVar

import anyio
import pytest
from anyio.lowlevel import checkpoint

from fibaction._runtime.notify import Notifier
from fibaction.wire.channel import Channel
from fibaction.wire.messages import Ping, encode
from fibaction.words.errors import ConnectionLost
from tests.transports.hearing import hearing

T = TypeVar("T")

LONG = 3600.0
"""A heartbeat that no test lives to see."""


async def settled() -> None:
    """Wait until nothing moves any more."""
    # On asyncio, anyio looks ten times a second: let the others have their turns before it does.
    for _ in range(50):
        await checkpoint()
    await anyio.wait_all_tasks_blocked()


class _Way:
    """One direction."""

    def __init__(self) -> None:
        self.frames: deque[bytes] = deque()
        self.is_stopped = False
        self.is_cut = False
        self.is_last: Callable[[bytes], bool] = lambda _frame: False
        """Tells the frame after which its reader closes the connection."""
        self.writes: list[tuple[float, list[bytes]]] = []
        self.pieces = 0
        self.news = Notifier()


class MemoryChannel(Channel):
    """One end of a connection."""

    def __init__(self, peer: str, incoming: _Way, outgoing: _Way) -> None:
        self.peer = peer
        self._incoming = incoming
        self._outgoing = outgoing

    async def send(self, frames: Sequence[bytes]) -> None:
        way = self._outgoing
        await checkpoint()
        while way.is_stopped and not way.is_cut:
            await way.news.wait()
        if way.is_cut:
            raise ConnectionLost(f"the connection to {self.peer} broke")
        way.writes.append((anyio.current_time(), list(frames)))
        way.frames += frames
        way.news.notify()
        if any(way.is_last(frame) for frame in frames):
            self.cut()

    async def receive(self) -> list[bytes]:
        way = self._incoming
        await checkpoint()
        while not way.frames:
            if way.is_cut:
                raise ConnectionLost(f"{self.peer} closed its side")
            await way.news.wait()
        frames = list(way.frames)
        way.frames.clear()
        return frames

    async def aclose(self) -> None:
        self.cut()

    def cut(self) -> None:
        """End the connection, both ways. What was sent before can still be read."""
        for way in (self._incoming, self._outgoing):
            way.is_cut = True
            way.news.notify()

    def stop_reading(self) -> None:
        """From now on, the other end cannot write."""
        self._incoming.is_stopped = True

    def close_after(self, is_last: Callable[[bytes], bool]) -> None:
        """Close the connection as soon as the other end has written such a frame."""
        self._incoming.is_last = is_last

    def take_a_piece(self) -> None:
        """Take a part of what the other end writes."""
        self._incoming.pieces += 1

    @property
    def progress(self) -> int:
        return self._outgoing.pieces

    @property
    def writes(self) -> list[tuple[float, list[bytes]]]:
        """What the other end has written, each time."""
        return self._incoming.writes

    def go_on_reading(self) -> None:
        self._incoming.is_stopped = False
        self._incoming.news.notify()

    @property
    def is_cut(self) -> bool:
        return self._incoming.is_cut

    async def cut_off(self) -> None:
        """Wait until the connection has ended."""
        while not self.is_cut:
            await self._incoming.news.wait()


def pair(one: str = "the client", other: str = "the server") -> tuple[MemoryChannel, MemoryChannel]:
    """Two ends: the server's, whose peer is `one`, and the client's, whose peer is `other`."""
    up, down = _Way(), _Way()
    return MemoryChannel(one, up, down), MemoryChannel(other, down, up)


class Peer:
    """One end of a connection, in the hands of a test."""

    def __init__(self, channel: MemoryChannel, decode: Callable[[bytes], Any]) -> None:
        self.channel = channel
        self._decode = decode
        self._heard: deque[Any] = deque()

    async def say(self, *messages: Any) -> None:
        """Send messages, all at once."""
        await self.channel.send([encode(message) for message in messages])

    async def hear(self, kind: type[T], within: float = 5) -> T:
        """The next message, signs of life apart; it is of that kind."""
        with anyio.fail_after(within):
            while not self._heard:
                self._take(await self.channel.receive())
        message = self._heard.popleft()
        assert isinstance(message, kind), message
        return message

    async def hear_all(self) -> list[Any]:
        """All messages until nothing moves any more, or the connection has ended."""
        await settled()
        if self.channel._incoming.frames:
            self._take(await self.channel.receive())
        messages = list(self._heard)
        self._heard.clear()
        return messages

    async def hear_the_end(self) -> None:
        """The other end closes the connection, and says no more before that."""
        with anyio.fail_after(30), pytest.raises(ConnectionLost):
            while True:
                self._take(await self.channel.receive())
        assert list(self._heard) == []

    def _take(self, frames: list[bytes]) -> None:
        messages = map(self._decode, frames)
        self._heard += (message for message in messages if not isinstance(message, Ping))


class Running:
    """A function that runs beside a test, and its answer."""

    def __init__(self, function: Callable[[], Any]) -> None:
        self._function = function
        self._group = anyio.create_task_group()
        self._done = anyio.Event()
        self._error: Exception | None = None
        self._answer: Any = None

    async def __aenter__(self) -> Running:
        await self._group.__aenter__()
        self._group.start_soon(self._run)
        await settled()
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._group.cancel_scope.cancel()
        await self._group.__aexit__(None, None, None)

    async def _run(self) -> None:
        try:
            self._answer = await self._function()
        except Exception as exc:
            self._error = exc
        self._done.set()

    @property
    def is_done(self) -> bool:
        return self._done.is_set()

    async def answer(self, within: float = 5) -> Any:
        """What it gives or raises."""
        with anyio.fail_after(within):
            await self._done.wait()
        if self._error is not None:
            raise self._error
        return self._answer


class Apart(Generic[T]):
    """A block that a task of its own enters and leaves. A test can cancel that task itself, without
    a scope, which asyncio alone can.
    """

    def __init__(self, block: AbstractAsyncContextManager[T]) -> None:
        self._block = block
        self._entered: asyncio.Future[T] = asyncio.Future()
        self._leaving = anyio.Event()
        self._task = asyncio.create_task(self._run())

    async def _run(self) -> None:
        async with self._block as value:
            self._entered.set_result(value)
            await self._leaving.wait()

    async def entered(self) -> T:
        """What the block is of, once it has begun."""
        with anyio.fail_after(30):
            return await self._entered

    async def canceled_while_it_leaves(self) -> None:
        """Leave the block, cancel the task when that has come to wait, and see it end at once."""
        self._leaving.set()
        await settled()
        assert not self._task.done()
        self._task.cancel()
        with anyio.fail_after(30):
            await asyncio.wait([self._task])
        assert self._task.cancelled()


@contextmanager
def logged() -> Generator[list[logging.LogRecord], None, None]:
    """What `fibaction.wire` logs; unlike `caplog`, it can be had for each example of a property."""
    with hearing() as heard:
        yield heard.records

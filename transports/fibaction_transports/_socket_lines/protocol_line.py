"""`ProtocolLine`: a line on asyncio, which needs no tasks to read and to write.

The event loop calls it with each piece of data, and it hands over the frames at once. anyio's
streams, which `sockets` uses on trio, have a task for each direction, and begin and end to watch
the socket for each piece. Measured in turns in one process, over loopback (Python 3.11, median of
7): a frame there and back takes 0.14 ms here and 4.0 times as much there; of 64 frames at once each
takes 4.7 us, or 2.9 times that.
"""

from __future__ import annotations

import asyncio  # noqa: TID251  # this module is for asyncio only
from collections.abc import Sequence
from contextlib import suppress
from contextvars import copy_context
from time import perf_counter
from typing import cast

import anyio.lowlevel

from fibaction.border.abc import Notifier
from fibaction.border.event_loop import SLICE
from fibaction.wire.channel import CHUNK, LEAVE, Line, NextFrames, OnFrames
from fibaction.wire.frames import Framing
from fibaction.words.errors import ConnectionLost

PIECE = 4 * CHUNK
"""Bytes that the socket is given at once, at most: asyncio copies what it cannot send of them."""
NEWS = 0.001
"""Seconds of a turn of the event loop in which lines handle as much news as a slice takes."""
LITTLE_NEWS = NEWS / 10  # to reset less in each turn would cost a short goal 2 %
NOTHING = memoryview(b"")


class LineTurns:
    """The lines that have frames left to handle: together they have one slice of each turn of the
    event loop, and continue one after another.

    However many lines there are, they delay the others together as little as one would. So they do
    if many have news in one turn: after `NEWS` seconds each handles one frame, and waits.
    """

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._context = copy_context()
        self._waiting: dict[ProtocolLine, None] = {}
        self._is_due = False
        self.used = 0.0
        """Seconds of this turn in which news were handled, and at most `LITTLE_NEWS` of others."""

    def use(self, seconds: float) -> None:
        """Count the time in which a line has handled news."""
        before, self.used = self.used, self.used + seconds
        if before < LITTLE_NEWS <= self.used:
            self._loop.call_soon(self._begin)  # before the sockets of the next turn

    def _begin(self) -> None:
        self.used = 0.0

    def add(self, line: ProtocolLine) -> None:
        """Let the line continue in a later turn."""
        self._waiting[line] = None
        self._schedule()

    def discard(self, line: ProtocolLine) -> None:
        """Remove a line that has ended, so that the others do not wait for it."""
        self._waiting.pop(line, None)

    def _schedule(self) -> None:
        if not self._is_due:
            self._is_due = True
            self._loop.call_soon(self._next, context=self._context)

    def _next(self) -> None:
        self._is_due = False
        ends = perf_counter() + SLICE
        left = len(self._waiting)
        while self._waiting and left:  # a line may end others
            left -= 1
            line = next(iter(self._waiting))
            del self._waiting[line]
            line.context.run(line.go_on)
            if line.has_rest:
                self._waiting[line] = None
            if perf_counter() >= ends:
                break
        if self._waiting:
            self._schedule()


class ProtocolLine(asyncio.BufferedProtocol, Line):
    """One connection.

    It reads into a buffer that it is given. Without one, asyncio allocates 256 KiB for each read,
    which the allocator may map and unmap each time. All lines of an event loop may share one: it is
    filled and read in one turn.
    """

    def __init__(
        self,
        framing: Framing,
        buffer: memoryview,
        peer: str = "",
        turns: LineTurns | None = None,
        early: bytes = b"",
    ) -> None:
        """Take the form of the frames, and what was read of them before the line is made."""
        self.peer = peer
        self._framing = framing
        self._buffer = buffer
        self._turns = turns or LineTurns()
        self._transport: asyncio.Transport
        self._loop = asyncio.get_running_loop()
        self.context = copy_context()
        """The context variables with which it handles frames."""
        self._rest: list[bytes] = []
        self._on_frames: OnFrames | None = None
        self._next_frames: NextFrames
        self._early = early
        self._unsent = NOTHING  # the rest of a large write, which the socket has not been given
        self._written = 0
        self._error: Exception | None = None
        self._due: asyncio.Handle | None = None  # the next write
        self._is_fetching = False
        self._is_full = False
        self._is_leaving = self._is_at_end = False
        self._changed = Notifier()

    @property
    def progress(self) -> int:
        """The bytes that the socket has taken."""
        return self._written - self._transport.get_write_buffer_size()

    def wake_writer(self, *, at_once: bool = False) -> None:
        if self._is_full or self._on_frames is None:
            pass  # frames are fetched when there is room, or when this line runs
        elif at_once and not self._is_fetching:
            if self._due is not None:
                self._due.cancel()  # it would find nothing to write
            self._write()
        elif self._due is None:
            self._due = self._loop.call_soon(self._write, context=self.context)

    async def run(self, on_frames: OnFrames, next_frames: NextFrames) -> None:
        self._on_frames, self._next_frames = on_frames, next_frames
        early, self._early = self._early, b""
        if early and self._error is None:
            self._handle(early)
        if not self._rest:
            self._transport.resume_reading()
        self.wake_writer()
        try:
            while self._error is None:
                await self._changed.wait()
        finally:
            self._rest = []
            self._turns.discard(self)
            self._pause_reading()
        raise self._error

    async def send(self, frames: Sequence[bytes]) -> None:
        await self.send_bytes(self._framing.encode(frames))

    async def send_bytes(self, data: bytes) -> None:
        """Send bytes that belong to no frame, before the line runs.

        Raises:
            ConnectionLost: The connection has ended.
        """
        data = self._take_rest() + data
        self._written += len(data)
        self._transport.write(data)
        while self._is_full and not self._transport.is_closing():
            await self._changed.wait()
        if self._transport.is_closing():
            raise ConnectionLost(f"the connection to {self.peer} broke")

    async def receive_bytes(self) -> bytes:
        """Return the next bytes that have arrived, before the line runs.

        Raises:
            anyio.BrokenResourceError: The connection has ended.
        """
        while not self._early:
            if self._error is not None:
                raise anyio.BrokenResourceError from self._error
            await self._changed.wait()
        data, self._early = self._early, b""
        if not self._transport.is_closing():
            self._transport.resume_reading()
        return data

    def begin(self, framing: Framing, early: bytes) -> None:
        """Change the form of the frames, before the line runs, and take what was read of them."""
        self._framing = framing
        self._early = early + self._early

    async def aclose(self) -> None:
        try:
            if not (self._is_at_end or self._transport.is_closing()):
                with suppress(OSError):  # the peer has gone, and the event loop has yet to notice
                    await self._take_leave()
        finally:  # asyncio can cancel the task itself, which no scope shields
            self._framing.close()
            self._transport.abort()
        await anyio.lowlevel.cancel_shielded_checkpoint()  # in which the socket is closed

    async def _take_leave(self) -> None:
        """Say goodbye, as the framing does it, and wait for the answer of the peer."""
        framing = self._framing
        last = framing.goodbye()
        if framing.is_closed and not last:
            return
        framing.close()
        self._is_leaving = True
        self._transport.write(self._take_rest() + last)
        if framing.ends_stream:
            self._transport.write_eof()
        framing.discard(self._early)
        self._transport.resume_reading()
        with anyio.move_on_after(LEAVE, shield=True):
            while not (self._is_at_end or (framing.is_closed and not self._is_full)):
                await self._changed.wait()

    def _write(self) -> None:
        self._due = None
        size, ends = 0, perf_counter() + SLICE
        try:
            while self._error is None and not self._is_full:
                data: bytes | memoryview = self._unsent
                if not data:
                    self._is_fetching = True
                    frames = self._next_frames()
                    self._is_fetching = False
                    if not (frames or self._framing.has_answer):
                        break
                    data = self._framing.encode(frames)
                    del frames  # they may be large
                if len(data) > PIECE:
                    view = memoryview(data)
                    data, self._unsent = view[:PIECE], view[PIECE:]
                else:
                    self._unsent = NOTHING
                self._written += len(data)
                self._transport.write(data)
                size += len(data)
                if size >= CHUNK or perf_counter() >= ends:  # other lines have their turn
                    self.wake_writer()
                    break
        except Exception as exc:
            self._end(exc)

    def _take_rest(self) -> bytes:
        """Return the rest of a large write, since something else is to follow it."""
        rest, self._unsent = bytes(self._unsent), NOTHING
        return rest

    def _handle(self, data: bytes | None) -> None:
        """Handle what has arrived, or the rest of what had arrived before."""
        assert self._on_frames is not None
        began = perf_counter()
        try:
            frames = self._rest if data is None else self._framing.feed(data)
            if data is not None and self._turns.used >= NEWS:
                self._rest = self._on_frames(frames[:1]) + frames[1:]
            else:
                self._rest = self._on_frames(frames)
            if self._framing.has_answer:
                self.wake_writer()
            if self._framing.has_ended and not self._rest:
                self._framing.check()
        except Exception as exc:
            self._end(exc)
        else:
            if data is not None:
                self._turns.use(perf_counter() - began)
            if self._rest and data is not None:
                self._pause_reading()
                self._turns.add(self)

    @property
    def has_rest(self) -> bool:
        """True if frames have arrived that are not handled yet."""
        return bool(self._rest) and self._error is None

    def go_on(self) -> None:
        """Handle frames that have arrived in an earlier turn."""
        self._handle(None)
        if not (self._rest or self._transport.is_closing()):
            self._transport.resume_reading()

    def _pause_reading(self) -> None:
        if not self._transport.is_closing():
            self._transport.pause_reading()

    def _end(self, error: Exception) -> None:
        if self._error is None:
            self._error = error
        self._turns.discard(self)
        self._changed.notify()

    # Called by the event loop

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        # Written bytes count as taken only when the socket has them.
        self._transport.set_write_buffer_limits(0)
        if not self.peer:
            self.peer = _peer_of(transport)

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        data = bytes(self._buffer[:nbytes])
        if self._is_leaving:
            self._framing.discard(data)
            self._changed.notify()
        elif self._on_frames is None:
            self._early += data
            self._transport.pause_reading()
            self._changed.notify()
        elif self._error is None:
            self._handle(data)

    def eof_received(self) -> bool:
        self._is_at_end = True
        how = "in the middle of a message" if self._framing.is_within_frame else "its side"
        self._end(ConnectionLost(f"{self.peer} closed {how}"))
        return True  # `aclose` closes it

    def connection_lost(self, exc: Exception | None) -> None:
        self._is_at_end = True
        error = ConnectionLost(f"the connection to {self.peer} broke")
        error.__cause__ = exc
        self._end(error)

    def pause_writing(self) -> None:
        self._is_full = True

    def resume_writing(self) -> None:
        self._is_full = False
        self._changed.notify()
        self.wake_writer()


def _peer_of(transport: asyncio.BaseTransport) -> str:
    address = transport.get_extra_info("peername")
    if isinstance(address, tuple):
        return f"{address[0]}:{address[1]}"
    # A peer that has reset the connection before this has no address any more.
    return "a peer that has left" if address is None else "a local process"

"""`Line`: a connection that moves frames, which every transport over the wire protocol supplies.

A transport over a stream of bytes wraps it in a `StreamChannel`; if its frames have another form
there than a length before each, as over WebSocket, it supplies a `Framing`. One that has frames of
its own implements `Channel`, whose two directions have a task each. One that needs no tasks,
because it is called with what arrives, implements `Line` itself.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from typing import TypeAlias

import anyio
from anyio.abc import ByteStream
from anyio.lowlevel import checkpoint_if_cancelled

from fibaction._runtime.notify import Notifier
from fibaction.wire.frames import Framing
from fibaction.words.errors import ActionError, ConnectionLost

CHUNK = 2**16
"""Bytes read or written at once: large, so that the cost of a call does not count, and small enough
for a slow line to move one within a heartbeat."""
LEAVE = 1.0
"""Seconds for a peer to take part in closing."""


OnFrames: TypeAlias = Callable[[list[bytes]], list[bytes]]
"""Takes the frames that have arrived; an empty list if only a piece of one has arrived. Returns
those that it has not handled: they come again in a later turn, before anything else."""
NextFrames: TypeAlias = Callable[[], list[bytes]]
"""Returns the frames to send next, if any. The next call says that those before are written."""


class Line(ABC):
    """A connection that moves frames both ways, in order and whole, while it runs."""

    peer: str
    """The address of the peer, for errors and logs, for example `127.0.0.1:51234`."""
    holds_briefly = False
    """True if executors wait only for moments for this peer to read the feedback of its goals."""

    @property
    def progress(self) -> int:
        """A number that grows with each piece of a message that the peer has taken.

        It tells a large message on a slow line from a peer that does not read.
        """
        return 0

    @abstractmethod
    def wake_writer(self, *, at_once: bool = False) -> None:
        """Schedule a write.

        Writes are normally coalesced until the next loop turn; `at_once` asks for an immediate
        write, as an optimisation that an implementation may ignore.
        """

    def share_turns(self, turn: anyio.Lock) -> None:  # noqa: B027  # a line may have its own way
        """Handle the rest of what has arrived with that lock, which all lines of a server have.

        However many of them are busy, they delay the others together as little as one would. Does
        nothing for a line that shares its turns in another way.
        """

    @abstractmethod
    async def run(self, on_frames: OnFrames, next_frames: NextFrames) -> None:
        """Call `on_frames` with what arrives, and send what `next_frames` returns.

        Frames that `on_frames` returns are given to it again in a later turn of the event loop, and
        nothing is read until it has taken all of them: a peer that sends faster than its messages
        can be handled has to wait, and only that peer.

        `next_frames` is called at first, after each `wake_writer()`, and after each write, until it
        returns none. Runs once, and does not return.

        Raises:
            ActionError: `on_frames` has raised it.
            ConnectionLost: The connection has ended.
            ProtocolError: The peer has sent something that is not a frame.
        """

    @abstractmethod
    async def send(self, frames: Sequence[bytes]) -> None:
        """Send frames while it does not run.

        Raises:
            ConnectionLost: The connection has ended.
        """

    @abstractmethod
    async def aclose(self) -> None:
        """Close the connection, at once if it cannot be closed cleanly."""


class Channel(Line):
    """A line whose two directions have a task each."""

    has_answer = False
    """True if `send` is to be called even without frames: for bytes that belong to no frame."""
    _wanted: Notifier | None = None
    _turn: anyio.Lock | None = None

    def share_turns(self, turn: anyio.Lock) -> None:
        self._turn = turn

    @abstractmethod
    async def send(self, frames: Sequence[bytes]) -> None:
        """Send frames, in as few writes as possible.

        Raises:
            ConnectionLost: The connection has ended.
        """

    @abstractmethod
    async def receive(self) -> list[bytes]:
        """Wait until something arrives, and return the frames that are complete by then, if any.

        Raises:
            ConnectionLost: The connection has ended.
            ProtocolError: The peer has sent something that is not a frame.
        """

    def wake_writer(self, *, at_once: bool = False) -> None:
        if self._wanted is not None:
            self._wanted.notify()

    async def run(self, on_frames: OnFrames, next_frames: NextFrames) -> None:
        wanted = self._wanted = Notifier()
        turn = self._turn or anyio.Lock()
        errors: list[ActionError] = []

        async def read() -> None:
            while True:
                frames = on_frames(await self.receive())
                while frames:
                    async with turn:  # in a later turn, even if the lock is free
                        frames = on_frames(frames)

        async def write() -> None:
            # Reading may have failed by now, and what is cut off here could not be followed by
            # the last message.
            await checkpoint_if_cancelled()
            while True:
                if (frames := next_frames()) or self.has_answer:
                    await self.send(frames)
                else:
                    await wanted.wait()

        async def guarded(part: Callable[[], Awaitable[None]]) -> None:
            try:
                await part()
            except ActionError as exc:
                errors.append(exc)
                tasks.cancel_scope.cancel()

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(guarded, read)
            tasks.start_soon(guarded, write)
        raise errors[0]


class StreamChannel(Channel):
    """Frames over a stream of bytes."""

    def __init__(self, stream: ByteStream, peer: str, framing: Framing) -> None:
        """Take a stream, and the form of its frames.

        The simplest form is a `FrameReader`: the server's (`WireServer.new_reader()`), or a
        client's own. The channel closes the form with the stream.
        """
        self.peer = peer
        self._stream = stream
        self._framing = framing
        self._unfinished = False
        self._pieces = 0

    @property
    def progress(self) -> int:
        return self._pieces

    @property
    def has_answer(self) -> bool:  # type: ignore[override]  # here it changes
        """True if `send` is to be called even without frames: for bytes that belong to no frame."""
        return self._framing.has_answer

    async def send(self, frames: Sequence[bytes]) -> None:
        await self._send(self._framing.encode(frames))

    async def _send(self, data: bytes) -> None:
        if self._unfinished:
            raise ConnectionLost(f"the last message to {self.peer} was cut off")
        self._unfinished = True
        try:
            for start in range(0, len(data), CHUNK):
                await self._stream.send(data[start : start + CHUNK])
                self._pieces += 1
        except (OSError, anyio.BrokenResourceError, anyio.ClosedResourceError) as exc:
            raise ConnectionLost(f"the connection to {self.peer} broke") from exc
        self._unfinished = False

    async def receive(self) -> list[bytes]:
        self._framing.check()
        data = await self._receive()
        frames = self._framing.feed(data)
        if self._framing.has_answer:
            self.wake_writer()
        return frames

    async def _receive(self) -> bytes:
        try:
            return await self._stream.receive(CHUNK)
        except anyio.EndOfStream:
            how = "in the middle of a message" if self._framing.is_within_frame else "its side"
            raise ConnectionLost(f"{self.peer} closed {how}") from None
        except (OSError, anyio.BrokenResourceError, anyio.ClosedResourceError) as exc:
            raise ConnectionLost(f"the connection to {self.peer} broke") from exc

    async def aclose(self) -> None:
        # Do not wait for a peer that does not take part in closing, or for a dead line.
        try:
            with anyio.move_on_after(LEAVE, shield=True):
                await self._take_leave()
        finally:  # asyncio can cancel the task itself, which no scope shields
            with (
                suppress(OSError, anyio.BrokenResourceError, anyio.ClosedResourceError),
                anyio.move_on_after(LEAVE, shield=True),
            ):
                await self._stream.aclose()

    async def _take_leave(self) -> None:
        """Say goodbye, as the framing does it, and wait for the answer of the peer."""
        framing = self._framing
        try:
            last = framing.goodbye()
            framing.close()
            if last:
                await self._send(last)
            if framing.ends_stream:
                with suppress(NotImplementedError):  # TLS
                    await self._stream.send_eof()
            while not framing.is_closed:
                framing.discard(await self._receive())
        except (ActionError, OSError, anyio.BrokenResourceError, anyio.ClosedResourceError):
            pass  # it was lost before, or the peer has closed in its way

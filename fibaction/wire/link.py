"""`Link`: what both ends of a connection do alike, whatever they say: queue, write, read, and watch
that the other end is alive. It knows messages only as bytes, but for the sign of life.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextlib import suppress

from anyio import CancelScope, create_task_group, move_on_after, sleep

from fibaction._notify import Notifier
from fibaction.exceptions import ActionError, ConnectionLost, ProtocolError
from fibaction.wire.channel import Line
from fibaction.wire.messages import Ping, encode

MISSED = 4
"""After so many signs of life that did not come, a peer is taken for dead: one that is late, or
lost on a bad line, is none."""
HIGH_WATER = 2**20
"""Bytes in the queue from which on whoever wants to send waits: some milliseconds of any line."""

OVERFULL = 2
"""How many times the high-water mark the queue may come to by what is not made to wait."""

PING = encode(Ping())


class Link:
    """One connection, from its first byte to its last."""

    def __init__(self, line: Line, heartbeat: float, high_water: int = HIGH_WATER) -> None:
        self.peer = line.peer
        self.peer_heartbeat = heartbeat
        """How often the peer will say something; it is told in the first message."""
        self._line = line
        self._heartbeat = heartbeat
        self._high_water = high_water
        self._queue: list[bytes] = []
        self._queued = 0
        self._source: Callable[[], list[bytes]] = list
        self._room = Notifier()
        self._is_writing = False
        self._posted = 0  # bytes of the queue that have not waited for room
        self._writing = self._writing_posted = 0  # of those
        self._writes = 0
        self._has_said = self._has_heard = True  # since `_watch` looked last
        self._error: ActionError | None = None
        self._scope = CancelScope()

    @property
    def is_open(self) -> bool:
        """Whether messages can still be sent."""
        return self._error is None

    def wake_writer(self, *, at_once: bool = False) -> None:
        """There is something to fetch from the source. See `Line.stir`."""
        self._line.wake_writer(at_once=at_once)

    def post(self, frame: bytes) -> None:
        """Queue a message. For small ones, of which there are few; after the end it is lost."""
        self._put(frame)
        # What has waited for room, and may be large, is not held against the peer.
        self._posted += len(frame)
        if self._posted > OVERFULL * self._high_water + len(frame):
            self.end(ProtocolError(f"{self.peer} asks for more than it reads"))

    def _put(self, frame: bytes) -> None:
        self._queue.append(frame)
        self._queued += len(frame)
        self._line.wake_writer()

    async def send(self, frame: bytes) -> None:
        """Queue a message as soon as there is room in the queue.

        Raises:
            ConnectionLost: The connection has ended.
        """
        while self._queued >= self._high_water and self._error is None:
            await self._room.wait()
        if self._error is not None:
            raise ConnectionLost(str(self._error)) from self._error
        self._put(frame)

    async def flush(self) -> None:
        """Wait until everything that is queued has been written, or the connection has ended."""
        while self._queued and self._error is None:
            await self._room.wait()

    async def say_last(self, frame: bytes) -> None:
        """After the end: tell the peer why, if it can still be told."""
        with suppress(ActionError), move_on_after(1):
            await self._line.send([frame])

    def end(self, error: ActionError) -> None:
        """End the connection for that reason, unless it has ended before."""
        if self._error is None:
            self._error = error
            self._room.notify()
            self._scope.cancel()

    async def run(
        self, handle: Callable[[bytes], None], source: Callable[[], list[bytes]] | None = None
    ) -> ActionError:
        """Read, write and watch until the connection ends, and say why it did.

        `handle` is called with each message that arrives, and raises nothing but `ActionError`,
        which ends the connection. `source` is asked for messages whenever the connection can take
        more, after each `stir()`, until it has none: so what there is to say waits where it is
        made, and not in a queue.
        """
        if source is not None:
            self._source = source

        def on_frames(frames: list[bytes]) -> None:
            self._has_heard = True
            try:
                for frame in frames:
                    if self._error is not None:
                        break
                    handle(frame)
            except ActionError as exc:
                self.end(exc)  # now: nothing more is to be fetched
                raise

        async def guarded(part: Callable[[], Awaitable[None]]) -> None:
            try:
                await part()
            except ActionError as exc:
                self.end(exc)

        async with create_task_group() as tasks:
            self._scope = tasks.cancel_scope
            if self._error is not None:
                self._scope.cancel()
            tasks.start_soon(guarded, self._watch)
            await guarded(lambda: self._line.run(on_frames, self._next_frames))
        assert self._error is not None
        return self._error

    def _next_frames(self) -> list[bytes]:
        """What to send next; what was fetched before has been written."""
        if self._is_writing:
            self._writes += 1
            self._has_said = True
            self._queued -= self._writing
            self._posted -= self._writing_posted
            self._room.notify()
        frames: list[bytes] = []
        if self._error is None:  # what is cut off by the end would cut off the last word, too
            self._writing = self._writing_posted = 0
            if self._queue:
                frames, self._queue = self._queue, frames
                self._writing, self._writing_posted = self._queued, self._posted
            frames += self._source()
        self._is_writing = bool(frames)
        return frames

    async def _watch(self) -> None:
        # It counts its own rounds, and reads no clock: what happens at each message stays cheap,
        # and a peer is not blamed for the time in which this process has not run.
        silent = stuck = unsaid = 0.0
        progress = self._progress
        while True:
            step = min(self._heartbeat, self.peer_heartbeat) / 2
            await sleep(step)
            silent = 0.0 if self._has_heard else silent + step
            if silent > MISSED * self.peer_heartbeat:
                raise ConnectionLost(f"{self.peer} has been silent for {silent:.1f} s")
            is_stuck = self._is_writing and progress == self._progress
            stuck = stuck + step if is_stuck else 0.0
            if stuck > MISSED * self._heartbeat:
                raise ConnectionLost(f"{self.peer} has read nothing for {stuck:.1f} s")
            unsaid = 0.0 if self._has_said else unsaid + step
            if unsaid >= self._heartbeat / 2:
                self.post(PING)
                unsaid = 0.0
            self._has_said = self._has_heard = False
            progress = self._progress

    @property
    def _progress(self) -> tuple[int, int]:
        return self._writes, self._line.progress


def naming(peer: str, error: ActionError) -> str:
    """What a connection ended with, as a line of the log that names the peer once."""
    text = str(error)
    return text if peer in text else f"{peer}: {text}"

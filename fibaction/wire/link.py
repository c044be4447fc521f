"""`Link`: one connection, the same at both ends: queue, read, write, and watch the peer.

Theory of operation
-------------------

A `Link` stands between a `Line`, which moves frames, and the half that gives the frames a meaning:
a `Session` at the server, a `RemoteConnection` at the client. It knows messages only as bytes, with
the exception of `Ping`.

*Sending.* There are three ways, for three kinds of messages:

- `post` queues a small message at once. There are few of these, such as credit or a rejection. A
  peer that makes them faster than it reads them is ended at `OVERFULL` times the high-water mark.
- `send` makes and queues a message as soon as the queue is below the high-water mark: back-pressure
  for answers, each of which has a task that can wait.
- The *source* is asked for frames when the line can take more, after `wake_writer()`, until it has
  none. Goals use it: feedback waits in its log, and not in a queue for each client, so a thousand
  goals of a slow client cost no memory here, and each gets its turn.

The line asks for frames by `_next_frames`. To be asked again means that the frames before are
written; that is how the queue knows how much of it is gone.

*Receiving.* The line calls `on_frames` with what arrives, and each frame goes to `handle`. It must
not wait; what takes time is started as a task, or waits for credit. After a slice of time the rest
goes back to the line, for a later turn, so that a peer that sends very many messages delays all
others by no more than that.

*The end.* A connection ends once, by the first error: one that `handle` raises, one of the line,
one of the heartbeat, or `end()`. From then on nothing more is fetched from the source, and what is
posted is lost; `send` raises. `run` returns the error, and after that `say_last` may still send one
message that tells the peer why.

*The peer.* Each side tells the other how often it will send something, at least: its heartbeat.
Where there is nothing else to say it sends a `Ping`. A peer is dead after `MISSED` of its
heartbeats without a byte from it, or after as many of the own heartbeats without progress of what
is being written (`Heartbeat`). It is sans-I/O, and without a clock: `Link` counts steps of half a
heartbeat, so that nothing has to be noted for each message, and a peer is not blamed for the time
in which this process did not run.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Awaitable, Callable
from contextlib import suppress
from time import perf_counter

from anyio import CancelScope, create_task_group, move_on_after, sleep
from anyio.abc import TaskGroup

from fibaction._runtime.log import clean_logger
from fibaction._runtime.notify import Notifier
from fibaction.border.event_loop import SLICE
from fibaction.wire.channel import CHUNK, Line
from fibaction.wire.frames import UNCOUNTED, FrameMemory
from fibaction.wire.messages import Ping, encode
from fibaction.words.errors import ActionError, ConnectionLost, ProtocolError

MISSED = 4
"""A peer is considered dead after this many missed heartbeats. Late or lost ones are tolerated."""

FIRST_STEP = 0.5
"""The longest step before the sides know each other's heartbeats, in seconds."""


class Heartbeat:
    """The heartbeats of both sides of one connection, and the time since each was seen."""

    def __init__(self, peer: str, interval: float) -> None:
        self.interval = interval
        """Seconds between the heartbeats of this side."""
        self.peer_interval = interval
        """Seconds between the heartbeats of the peer; its first message tells them."""
        self.is_agreed = False
        """True if the peer has told its heartbeat, in its first message."""
        self._peer = peer
        self._silent = self._stuck = self._unsaid = 0.0

    def agree(self, peer_interval: float, longest: float = math.inf) -> None:
        """Note the heartbeat of the peer, and the longest one that it accepts of this side."""
        self.peer_interval = peer_interval
        self.interval = min(self.interval, longest)
        self.is_agreed = True

    @property
    def step(self) -> float:
        """Seconds between two calls of `tick`."""
        step = min(self.interval, self.peer_interval) / 2
        # The first message of the peer may ask for shorter ones, and no step is cut short.
        return step if self.is_agreed else min(step, FIRST_STEP)

    def tick(self, step: float, *, has_heard: bool, has_said: bool, is_stuck: bool) -> bool:
        """Count a step of so many seconds; return whether a heartbeat is to be sent now.

        The arguments say what has happened in the step: whether anything has arrived, whether
        anything was written, and whether a write is under way that has made no progress.

        Raises:
            ConnectionLost: The peer is dead.
        """
        self._silent = 0.0 if has_heard else self._silent + step
        if self._silent > MISSED * self.peer_interval:
            raise ConnectionLost(f"{self._peer} has been silent for {self._silent:.1f} s")
        self._stuck = self._stuck + step if is_stuck else 0.0
        if self._stuck > MISSED * self.interval:
            raise ConnectionLost(f"{self._peer} has read nothing for {self._stuck:.1f} s")
        self._unsaid = 0.0 if has_said else self._unsaid + step
        if self._unsaid < self.interval / 2:
            return False
        self._unsaid = 0.0
        return True


logger = clean_logger("fibaction.wire")

HIGH_WATER = 2**20
"""Bytes in the queue above which `send` waits: some milliseconds of any line."""
OVERFULL = 2
"""Limit for messages queued without back-pressure, as a multiple of the high-water mark."""
PING = encode(Ping())
FIRST_PING = encode([Ping.__struct_config__.tag, "\r\n\r\n"])
"""A `Ping` with a blank line in it, which peers ignore. A client sends it while it has no answer: a
web server waits for such a line, and then answers, by which it is known."""


class Link:
    """One connection, from its first byte to its last."""

    def __init__(
        self,
        line: Line,
        heartbeat: float,
        high_water: int = HIGH_WATER,
        memory: FrameMemory | None = None,
    ) -> None:
        """Count large frames in a memory, if one is given, while they are written."""
        self.peer = line.peer
        self.holds_briefly = line.holds_briefly
        """True if executors wait only for moments for this peer to read feedback."""
        self.is_open = True
        """True if messages can still be sent."""
        self.wake_writer = line.wake_writer
        """Asks the source for frames soon. See `Line.wake_writer`."""
        self.heartbeat = Heartbeat(line.peer, heartbeat)
        self.first_ping = PING
        """The heartbeat that is sent before the first message of the peer."""
        self._line = line
        self._high_water = high_water
        self._queue: deque[tuple[bytes, bool]] = deque()  # frames, and whether they were posted
        self._queued = 0
        self._source: Callable[[], list[bytes]] = list
        self._room = Notifier()
        self._is_writing = False
        self._posted = 0  # bytes of the queue that have not waited for room
        self._writing = self._writing_posted = 0  # of those
        self._writes = 0
        self._memory = memory
        self._is_counted = False
        self._has_said = self._has_heard = True  # since the last step of `_watch`
        self._error: ActionError | None = None
        self._scope = CancelScope()

    def post(self, frame: bytes) -> None:
        """Queue a small message; after the end it is lost."""
        self._queue.append((frame, True))
        self._queued += len(frame)
        self.wake_writer()
        # A message that has waited for room may be large, and does not count.
        self._posted += len(frame)
        if self._posted > OVERFULL * self._high_water + len(frame):
            self.end(ProtocolError(f"{self.peer} asks for more than it reads"))

    async def send(self, make: Callable[[], bytes]) -> None:
        """Queue a message as soon as the queue has room; `make` is called then, and returns it.

        So the answers that wait take no memory for their bytes.

        Raises:
            ConnectionLost: The connection has ended.
        """
        while self._queued >= self._high_water and self._error is None:
            await self._room.wait()
        if self._error is not None:
            raise ConnectionLost(str(self._error)) from self._error
        frame = make()
        self._queue.append((frame, False))
        self._queued += len(frame)
        self.wake_writer()

    async def flush(self) -> None:
        """Wait until everything that is queued has been written, or the connection has ended."""
        while self._queued and self._error is None:
            await self._room.wait()

    async def ended(self) -> None:
        """Wait until the connection has ended."""
        while self._error is None:
            await self._room.wait()

    async def say_last(self, frame: bytes) -> None:
        """Tell the peer after the end why it has ended, if the line still works."""
        with suppress(ActionError), move_on_after(1):
            await self._line.send([frame])

    def end(self, error: ActionError) -> None:
        """End the connection with that error, unless it has ended before."""
        if self._error is None:
            self._error = error
            self.is_open = False
            self._room.notify()
            self._scope.cancel()

    async def run(
        self,
        handle: Callable[[bytes], None],
        source: Callable[[], list[bytes]] | None = None,
        started: Callable[[TaskGroup], None] | None = None,
    ) -> ActionError:
        """Read, write and watch the peer until the connection ends; return the error that ended it.

        `handle` is called with each message that arrives; an `ActionError` that it raises ends the
        connection. `source` is asked for messages when the line can take more, after each
        `wake_writer()`, until it returns none. `started` is called at first, with a task group
        whose tasks are canceled when the connection ends.
        """
        if source is not None:
            self._source = source

        def on_frames(frames: list[bytes]) -> list[bytes]:
            self._has_heard = True
            ends = perf_counter() + SLICE
            try:
                for handled, frame in enumerate(frames):
                    if self._error is not None:
                        break
                    if handled and perf_counter() >= ends:
                        return frames[handled:]
                    handle(frame)
            except ActionError as exc:
                self.end(exc)  # now: nothing more is to be fetched
                raise
            return []

        async def guarded(part: Callable[[], Awaitable[None]]) -> None:
            try:
                await part()
            except ActionError as exc:
                self.end(exc)

        async with create_task_group() as tasks:
            self._scope = tasks.cancel_scope
            if started is not None:
                started(tasks)
            if self._error is not None:
                self._scope.cancel()
            tasks.start_soon(guarded, self._watch)
            await guarded(lambda: self._line.run(on_frames, self._next_frames))
        self._count([])
        assert self._error is not None
        # It is kept, and the frames of its traceback have a message that may be large.
        return self._error.with_traceback(None)

    def _next_frames(self) -> list[bytes]:
        """Return the frames to send next; those before have been written."""
        if self._is_writing:
            self._writes += 1
            self._has_said = True
            if self._writing:  # what the source gives is not of the queue
                self._queued -= self._writing
                self._posted -= self._writing_posted
                self._room.notify()
        frames: list[bytes] = []
        if self._error is None:  # a half-written frame would make the last message unreadable
            self._writing = self._writing_posted = 0
            # The rest of the queue is for the next write: other connections have their turn.
            while self._queue and self._writing < CHUNK:
                frame, is_posted = self._queue.popleft()
                frames.append(frame)
                self._writing += len(frame)
                self._writing_posted += is_posted * len(frame)
            frames += self._source()
        self._is_writing = bool(frames)
        if frames or self._is_counted:
            self._count(frames)
        return frames

    def _count(self, frames: list[bytes]) -> None:
        """Count the frames that are being written, if they are large."""
        if self._memory is not None:
            size = max(0, sum(map(len, frames)) - UNCOUNTED)
            if size or self._is_counted:
                self._is_counted = size > 0
                self._memory.hold(self, size)

    def give_up(self) -> None:
        """End the connection: the peer does not take a large message, whose memory is needed."""
        self._count([])
        self.end(ConnectionLost(f"{self.peer} takes too long for a large message at a busy server"))

    async def _watch(self) -> None:
        heartbeat, progress = self.heartbeat, self._progress
        while True:
            step = heartbeat.step
            await sleep(step)
            # What a line has to say by itself, such as pongs, may be in the way of the queue.
            is_stuck = (self._is_writing or self._queued > 0) and progress == self._progress
            if heartbeat.tick(
                step, has_heard=self._has_heard, has_said=self._has_said, is_stuck=is_stuck
            ):
                self.post(PING if heartbeat.is_agreed else self.first_ping)
            self._has_said = self._has_heard = False
            progress = self._progress

    @property
    def _progress(self) -> tuple[int, int]:
        return self._writes, self._line.progress


async def close_line(line: Line) -> None:
    """Close a line. If that fails, the log tells it, and no error is raised: the task group of a
    server is that of all its lines.
    """
    try:
        await line.aclose()
    except Exception as exc:
        with suppress(Exception):  # the handler of a log may fail, too
            logger.warning("%s: the connection could not be closed: %r", line.peer, exc)


def naming(peer: str, error: ActionError) -> str:
    """Return an error that ended a connection as a line of the log, which names the peer once."""
    text = str(error)
    return text if peer in text else f"{peer}: {text}"

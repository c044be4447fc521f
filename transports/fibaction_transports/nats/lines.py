"""Lines of the wire protocol over messages of a broker: `ClientLines`, `WorkerLines`.

Theory of operation
-------------------

A broker delivers messages in order, and each at most once: some may be lost, and a message may be
too small for a frame. So a line is a stream of bytes in numbered pieces, as in TCP. Each
direction has messages of one byte for the kind, and eight for a number:

    O 0         from the client: begin the line; the worker answers A 0
    D n data    the piece n, from 0 on
    A n         all pieces before n are taken
    X 0         the sender has closed the line

At most `WINDOW` pieces are under way; a sender waits for an A then. So a reader that takes nothing
holds the sender back, and neither end holds more than a window.

Each line has a subject for each direction, see `names`; clients number their lines. A worker that
gets a piece of a line that it does not know answers that the line is closed.

A number that is left out breaks the line, and so does the broker's answer that nobody listens to
the other end. Whatever else happens is noticed by the heartbeats of the wire protocol, which send
pieces, too. A line that broke is not repaired: `fibaction.wire` dials again, and asks for what was
under way.
"""

from __future__ import annotations

import secrets
from collections import deque
from collections.abc import Callable, Sequence
from contextvars import copy_context
from time import perf_counter

import anyio

from fibaction.border.abc import Notifier
from fibaction.border.event_loop import SLICE, asyncio_loop
from fibaction.wire.channel import CHUNK, Line, NextFrames, OnFrames
from fibaction.wire.frames import MAX_FRAME, FrameReader, framed
from fibaction.words.errors import ConnectionLost, ServerNotFound
from fibaction_transports.nats.broker.broker import Broker, BrokerSubscription, Message
from fibaction_transports.nats.names import FleetNames

WINDOW = 64
"""Pieces under way in each direction."""
ACK_EACH = 16
"""Pieces after which they are acknowledged."""
DIAL_TIMEOUT = 1.0
"""Seconds that a worker has to begin a line. The first message to a killed one may vanish."""

OPEN, DATA, TAKEN, CLOSED = b"O", b"D", b"A", b"X"
HEAD = 9
"""Bytes of a message before the data."""


def message_of(kind: bytes, number: int = 0, data: bytes | memoryview = b"") -> bytes:
    """Return a message of a line."""
    return b"".join((kind, number.to_bytes(8, "big"), data))


class PieceLine(Line):
    """One end of a line, without tasks of its own.

    Pieces are handled as they come, in the turn of the event loop that brings them. Those that take
    too long are handled by `run`, in turns with other lines.
    """

    def __init__(
        self,
        broker: Broker,
        address: tuple[str, str],
        peer: str,
        reader: FrameReader,
        on_closed: Callable[[], None],
    ) -> None:
        """Take the subjects to send to and to receive from; both ends know both."""
        self.peer = peer
        self._broker = broker
        self._to, self._from = address
        self._reader = reader
        self._on_closed = on_closed
        self._piece = min(CHUNK, broker.max_record - HEAD)
        self._loop = asyncio_loop()
        self._context = copy_context()
        self._turn: anyio.Lock | None = None
        # From here to there
        self._next_frames: NextFrames | None = None
        self._unsent: deque[memoryview] = deque()
        self._sent = 0
        self._taken_there = 0
        self._is_due = False
        self._is_fetching = False
        # From there to here
        self._on_frames: OnFrames | None = None
        self._pieces: deque[bytes] = deque()
        self._rest: list[bytes] = []
        self._received = 0
        self._taken_here = 0
        self._told = 0
        self._is_open = False
        self._error: Exception | None = None
        self._changed = Notifier()

    @property
    def progress(self) -> int:
        """The pieces that the other end has taken."""
        return self._taken_there

    def share_turns(self, turn: anyio.Lock) -> None:
        self._turn = turn

    # From the broker

    def handle(self, message: Message) -> None:
        """Take a message of the other end."""
        data = message.data
        if message.has_no_responders:
            self.end(ConnectionLost(f"{self.peer} is gone"))
        elif len(data) < HEAD:
            self.end(ConnectionLost(f"{self.peer} sent a piece that is too short"))
        else:
            self._handle(data[:1], int.from_bytes(data[1:HEAD], "big"), data)

    def _handle(self, kind: bytes, number: int, data: bytes) -> None:
        if kind == DATA:
            if number != self._received:
                self.end(ConnectionLost(f"a piece of the line to {self.peer} was lost"))
            elif self._received - self._taken_here >= WINDOW:
                self.end(ConnectionLost(f"{self.peer} sent more than {WINDOW} pieces"))
            elif self._error is None:
                self._received += 1
                self._pieces.append(data[HEAD:])
                self._take()
        elif kind == TAKEN:
            if self._taken_there <= number <= self._sent:
                self._is_open = True
                self._taken_there = number
                self._publish_unsent()
                self.wake_writer()
                self._changed.notify()
        elif kind == CLOSED:
            self.end(ConnectionLost(f"{self.peer} closed its side"))

    def end(self, error: Exception) -> None:
        """End the line with an error."""
        if self._error is None:
            self._error = error
        self._changed.notify()

    def _take(self) -> None:
        """Handle the pieces that have arrived, until one leaves frames for a later turn."""
        while self._pieces and not self._rest and self._on_frames is not None:
            try:
                self._rest = self._on_frames(self._reader.feed(self._pieces.popleft()))
            except Exception as exc:
                self.end(exc)
                return
            self._taken_here += 1
            if self._taken_here - self._told >= ACK_EACH:
                self._told = self._taken_here
                self._publish(TAKEN, self._told)
        if self._rest:
            self._changed.notify()

    # The client's side

    async def open(self) -> None:
        """Begin the line.

        Raises:
            ServerNotFound: There is no subscriber, or no answer.
        """
        self._publish(OPEN)
        with anyio.move_on_after(DIAL_TIMEOUT):
            while not (self._is_open or self._error):
                await self._changed.wait()
        if not self._is_open:
            raise ServerNotFound(f"{self.peer} does not answer") from self._error

    def accept(self) -> None:
        """Answer that the line has begun."""
        self._publish(TAKEN)

    # The parts of a line

    def wake_writer(self, *, at_once: bool = False) -> None:
        if self._next_frames is None or self._is_full:
            pass  # frames are fetched when there is room, or when this line runs
        elif at_once and not self._is_fetching:
            self._write()
        elif not self._is_due:
            self._is_due = True
            self._loop.call_soon(self._write, context=self._context)

    async def run(self, on_frames: OnFrames, next_frames: NextFrames) -> None:
        self._on_frames, self._next_frames = on_frames, next_frames
        turn = self._turn or anyio.Lock()
        try:
            self._take()
            self.wake_writer()
            while self._error is None:
                if self._rest:
                    async with turn:  # in a later turn, even if the lock is free
                        self._go_on()
                else:
                    await self._changed.wait()
        finally:
            self._on_frames = self._next_frames = None
        raise self._error

    def _go_on(self) -> None:
        """Handle frames that were left for a later turn, and what came after them."""
        assert self._on_frames is not None
        try:
            self._rest = self._on_frames(self._rest)
        except Exception as exc:
            self.end(exc)
        else:
            self._take()

    async def send(self, frames: Sequence[bytes]) -> None:
        self._add(framed(frames))
        while self._unsent and self._error is None:
            await self._changed.wait()
        if self._error is not None:
            raise ConnectionLost(f"the line to {self.peer} broke") from self._error

    async def aclose(self) -> None:
        self._reader.close()
        self.end(ConnectionLost(f"the line to {self.peer} was closed here"))
        self._pieces.clear()
        self._unsent.clear()
        self._on_closed()
        self._publish(CLOSED)

    # Writing

    @property
    def _is_full(self) -> bool:
        return bool(self._unsent) or self._sent - self._taken_there >= WINDOW

    def _write(self) -> None:
        """Send what there is, up to a slice, after which other lines have their turn."""
        self._is_due = False
        size, ends = 0, perf_counter() + SLICE
        try:
            while self._next_frames is not None and self._error is None and not self._is_full:
                self._is_fetching = True
                frames = self._next_frames()
                self._is_fetching = False
                if not frames:
                    break
                data = framed(frames)
                self._add(data)
                size += len(data)
                if size >= CHUNK or perf_counter() >= ends:
                    self.wake_writer()
                    break
        except Exception as exc:
            self.end(exc)

    def _add(self, data: bytes) -> None:
        view = memoryview(data)
        step = self._piece
        self._unsent.extend(view[start : start + step] for start in range(0, len(view), step))
        self._publish_unsent()

    def _publish_unsent(self) -> None:
        while self._unsent and self._sent - self._taken_there < WINDOW:
            self._publish(DATA, self._sent, self._unsent.popleft())
            self._sent += 1

    def _publish(self, kind: bytes, number: int = 0, data: bytes | memoryview = b"") -> None:
        reply = "" if kind == CLOSED else self._from
        self._broker.publish(self._to, message_of(kind, number, data), reply)


class ClientLines:
    """The lines of one client, to any workers."""

    def __init__(
        self,
        broker: Broker,
        names: FleetNames,
        client_id: str = "",
        *,
        max_frame: int = MAX_FRAME,
    ) -> None:
        """Take a broker; `client_id` is a token of subjects, random by default."""
        self._broker = broker
        self._names = names
        self._client = client_id or secrets.token_hex(8)
        self._max_frame = max_frame
        self._lines: dict[str, PieceLine] = {}
        self._last = 0
        self._subscription: BrokerSubscription | None = None

    async def open(self) -> None:
        """Begin to listen for workers.

        Raises:
            BrokerAway: There is no connection to a broker.
        """
        subject = self._names.down(self._client)
        self._subscription = await self._broker.subscribe(subject, self._on_message)

    def close(self) -> None:
        """Listen no more; the lines are closed by their users."""
        if self._subscription is not None:
            self._subscription.close()

    async def dial(self, worker: str) -> Line:
        """Open a line to a worker.

        Raises:
            ServerNotFound: The worker is not there.
        """
        self._last += 1
        number = str(self._last)
        line = self._lines[number] = PieceLine(
            self._broker,
            (self._names.up(worker, self._client, number), self._names.down(self._client, number)),
            f"worker {worker!r}",
            FrameReader(self._max_frame),
            lambda: self._forget(number),
        )
        try:
            await line.open()
        except BaseException:
            await line.aclose()
            raise
        return line

    def _forget(self, number: str) -> None:
        self._lines.pop(number, None)

    def _on_message(self, message: Message) -> None:
        line = self._lines.get(message.subject.rpartition(".")[2])
        if line is not None:
            line.handle(message)


class WorkerLines:
    """The lines to one worker, from any clients."""

    def __init__(
        self,
        broker: Broker,
        names: FleetNames,
        worker: str,
        new_reader: Callable[[], FrameReader],
        start: Callable[[Line], None],
    ) -> None:
        """Take a broker, and what a `WireServer` has: `new_reader` and `start`."""
        self._broker = broker
        self._names = names
        self._worker = worker
        self._new_reader = new_reader
        self._start = start
        self._lines: dict[str, PieceLine] = {}
        self._subscription: BrokerSubscription | None = None

    async def open(self) -> None:
        """Begin to listen for clients.

        Raises:
            BrokerAway: There is no connection to a broker.
        """
        subject = self._names.up(self._worker)
        self._subscription = await self._broker.subscribe(subject, self._on_message)

    def close(self) -> None:
        """Take no more clients, and end the lines that are open."""
        if self._subscription is not None:
            self._subscription.close()
        for line in tuple(self._lines.values()):
            line.end(ConnectionLost("the worker has stopped"))

    def _on_message(self, message: Message) -> None:
        subject = message.subject
        line = self._lines.get(subject)
        if line is not None:
            line.handle(message)
            return
        client, number = subject.split(".")[-2:]
        kind = message.data[:1]
        if kind == OPEN:
            line = self._lines[subject] = PieceLine(
                self._broker,
                (self._names.down(client, number), subject),
                f"nats client {client[:4]}",
                self._new_reader(),
                lambda: self._forget(subject),
            )
            line.accept()
            self._start(line)
        elif kind == DATA:  # of a line that is closed here, or that a lost worker had
            self._broker.publish(self._names.down(client, number), message_of(CLOSED))

    def _forget(self, subject: str) -> None:
        self._lines.pop(subject, None)

"""Lines of the wire protocol over messages of a broker.

Theory of operation
-------------------

A broker delivers messages in order, and each at most once: some may be lost, and a message may be
too small for a frame. So a line is a stream of bytes in numbered pieces, as TCP has it. Each
direction has messages of one byte for the kind, and eight for a number:

    O 0         from the client: begin the line; the worker answers A 0
    D n data    the piece n, from 0 on
    A n         all pieces before n are taken
    X 0         the sender has closed the line

At most `WINDOW` pieces are under way; a sender waits for an A then. So a reader that takes nothing
holds the sender back, and neither end holds more than a window.

A number that is left out breaks the line, and so does the broker's answer that nobody listens to
the other end. Whatever else happens is noticed by the heartbeats of the wire protocol, which send
pieces, too. A line that broke is not repaired: `fibaction.wire` dials again, and asks for what was
under way. A worker that gets a piece of a line that it does not know answers with X.

Each line has a subject for each direction, see `names`. Clients number their lines.
"""

from __future__ import annotations

import secrets
from collections import deque
from collections.abc import Callable, Sequence

import anyio

from fibaction._notify import Notifier
from fibaction.exceptions import ActionError, ConnectionLost, ServerNotFound, copy_of
from fibaction.wire.channel import CHUNK, Channel, Line
from fibaction.wire.frames import MAX_FRAME, FrameReader, framed
from fibaction_transports.nats.broker import Broker, Message, Subscription
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


def _message(kind: bytes, number: int = 0, data: bytes | memoryview = b"") -> bytes:
    return b"".join((kind, number.to_bytes(8, "big"), data))


class PieceLine(Channel):
    """One end of a line."""

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
        self._sent = 0
        self._taken_there = 0
        self._received = 0
        self._taken_here = 0
        self._told = 0
        self._pieces: deque[bytes] = deque()
        self._unfinished = False
        self._is_open = False
        self._error: ActionError | None = None
        self._arrived = Notifier()
        self._room = Notifier()

    @property
    def progress(self) -> int:
        """The pieces that the other end has taken."""
        return self._taken_there

    # From the broker

    def handle(self, message: Message) -> None:
        """Take a message of the other end."""
        data = message.data
        if message.nobody_listens:
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
                self._arrived.notify()
        elif kind == TAKEN:
            if self._taken_there <= number <= self._sent:
                self._is_open = True
                self._taken_there = number
            self._room.notify()
        elif kind == CLOSED:
            self.end(ConnectionLost(f"{self.peer} closed its side"))

    def end(self, error: ActionError) -> None:
        """End the line with an error; what has arrived before is still read."""
        if self._error is None:
            self._error = error
        self._arrived.notify()
        self._room.notify()

    # The client's side

    async def open(self) -> None:
        """Begin the line.

        Raises:
            ServerNotFound: Nobody listens, or nobody answers.
        """
        self._publish(OPEN)
        with anyio.move_on_after(DIAL_TIMEOUT):
            while not (self._is_open or self._error):
                await self._room.wait()
        if not self._is_open:
            raise ServerNotFound(f"{self.peer} does not answer") from self._error

    def accept(self) -> None:
        """Answer that the line has begun."""
        self._publish(TAKEN)

    # The parts of a channel

    async def send(self, frames: Sequence[bytes]) -> None:
        data = memoryview(framed(frames))
        if self._unfinished:
            raise ConnectionLost(f"the last message to {self.peer} was cut off")
        self._unfinished = True
        for start in range(0, len(data), self._piece):
            while self._sent - self._taken_there >= WINDOW and self._error is None:
                await self._room.wait()
            if self._error is not None:
                raise copy_of(self._error)
            self._publish(DATA, self._sent, data[start : start + self._piece])
            self._sent += 1
        self._unfinished = False

    async def receive(self) -> list[bytes]:
        while not self._pieces:
            if self._error is not None:
                raise copy_of(self._error)
            await self._arrived.wait()
        pieces, self._pieces = self._pieces, deque()
        self._taken_here += len(pieces)
        if self._taken_here - self._told >= ACK_EACH:
            self._told = self._taken_here
            self._publish(TAKEN, self._told)
        return self._reader.feed(pieces[0] if len(pieces) == 1 else b"".join(pieces))

    async def aclose(self) -> None:
        self._reader.close()
        self.end(ConnectionLost(f"the line to {self.peer} was closed here"))
        self._pieces.clear()
        self._on_closed()
        self._publish(CLOSED)

    def _publish(self, kind: bytes, number: int = 0, data: bytes | memoryview = b"") -> None:
        reply = "" if kind == CLOSED else self._from
        self._broker.publish(self._to, _message(kind, number, data), reply)


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
        self._subscription: Subscription | None = None

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
        self._subscription: Subscription | None = None

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
            self._broker.publish(self._names.down(client, number), _message(CLOSED))

    def _forget(self, subject: str) -> None:
        self._lines.pop(subject, None)

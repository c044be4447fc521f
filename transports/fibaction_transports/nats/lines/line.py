"""Lines of clients and of workers, see `piece_line`.

Each line has a subject for each direction, see `names`; clients number their lines. A worker that
gets a piece of a line that it does not know answers that the line is closed.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable

from fibaction.wire.channel import Line
from fibaction.wire.frames import MAX_FRAME, FrameReader
from fibaction.words.errors import ConnectionLost
from fibaction_transports.nats.broker.broker import Broker, BrokerSubscription, Message
from fibaction_transports.nats.lines.piece_line import CLOSED, DATA, OPEN, PieceLine, message_of
from fibaction_transports.nats.names import FleetNames


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

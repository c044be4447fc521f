"""Consumers of JetStream: `RecordWatch` for records, and `NoteQueue` for notes.

Theory of operation
-------------------

The consumer of a watch delivers the newest record of each subject, and then all new ones, to an
inbox of this client. It is kept in the memory of one broker, so it is gone after a restart of that
one. It counts what it delivers; a number that is left out is a gap. Nothing of this is repaired in
place: after a gap, after heartbeats that did not come, and after each reconnection, there is a new
consumer and a new inbox, and all records come again.

In a cluster the consumer may be at a broker that lags: what was written a moment before may come
after the end of the first records, as a change.

The broker asks now and then whether what it has delivered was taken (flow control); it is told so
when `next` has returned it. So a reader that is slow holds the broker back, and not the memory.

Each subject of notes has one consumer, which all workers share; it is kept as long as its stream. A
worker asks it for one note, and gets it when there is one. A worker that is gone has its note come
again to another one.
"""

from __future__ import annotations

import base64
from collections import deque
from collections.abc import AsyncGenerator, Mapping
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from typing import Any

import anyio
import msgspec

from fibaction.border.abc import Notifier
from fibaction.border.event_loop import loop_clock
from fibaction_transports.nats.broker import jetstream
from fibaction_transports.nats.broker.broker import (
    BrokerAway,
    BrokerRecord,
    BrokerSubscription,
    BrokerWatch,
    Message,
    NoResponders,
    Note,
)
from fibaction_transports.nats.broker.client import NatsClient
from fibaction_transports.nats.names import stream_of_note

HEARTBEAT = 2
"""Seconds between heartbeats of a consumer that has nothing to deliver."""
HEAD = "Fibaction-Head"
"""The header with the head of a record, in base64."""
MISSED = 2.5
"""A consumer is gone after so many heartbeats without a message."""
LOOK_AGAIN = 1.0
"""Seconds until a stream that is missing is looked for again."""
ACK_WAIT = 5
"""Seconds after which a note that is not done comes again."""
ASKED_FOR = 5
"""Seconds for which a consumer remembers that it was asked for a note."""
LATENESS = 1.0
"""Seconds that its answer may be late."""


class _ConsumerMaker:
    """Makes the consumers of one subject.

    Brokers without a leader do not answer, and the next request may find one. So the first request
    has a short time, and the next ones longer ones.
    """

    def __init__(self, client: NatsClient, stream: str, subject: str) -> None:
        self._client = client
        self._stream = stream
        self._subject = subject
        self._timeout = jetstream.INFO_TIMEOUT

    async def make(self, name: str, config: Mapping[str, object]) -> dict[str, Any]:
        """Make a consumer, or find the one of this name, and return the answer.

        Raises:
            BrokerAway: There was no answer; the consumer may be made nevertheless.
            ApiError, NoResponders: It cannot be made now.
        """
        config = {"name": name, "filter_subject": self._subject, **config}
        body = msgspec.json.encode({"stream_name": self._stream, "config": config})
        api = f"CONSUMER.CREATE.{self._stream}.{name}.{self._subject}"
        try:
            answer = await jetstream.call(self._client, api, body, self._timeout)
        except BrokerAway:
            self._timeout = min(2 * self._timeout, jetstream.API_TIMEOUT)
            raise
        self._timeout = jetstream.INFO_TIMEOUT
        return answer


class RecordWatch(BrokerWatch):
    """The records of a subject, and then each change."""

    def __init__(
        self, client: NatsClient, stream: str, subject: str, since: int | None = None
    ) -> None:
        """Watch the newest record of each subject; with `since`, the heads of all records that were
        stored at that time or later.
        """
        self._client = client
        self._stream = stream
        self._maker = _ConsumerMaker(client, stream, subject)
        self._since = since
        self._inbox: BrokerSubscription | None = None
        self._consumer = ""
        self._connection = 0  # the one that the consumer belongs to
        self._records: list[BrokerRecord] = []
        self._taken = 0  # what the consumer has delivered
        self._is_complete = False  # all records that were there at first have come
        self._is_told = False  # and `next` has said so
        self._is_missing = False
        self._is_broken = True
        self._clock = loop_clock()
        self._heard = 0.0
        self._flow: list[str] = []
        self._news = Notifier()
        client.to_notify.add(self._news)

    async def next(self) -> list[BrokerRecord] | None:
        while True:
            if self._is_stale():
                await self._begin()
            for reply in self._flow:
                self._client.publish(reply, b"")
            self._flow.clear()
            if self._records:
                records, self._records = self._records, []
                return records
            if self._is_complete and not self._is_told:
                self._is_told = True
                return None
            with anyio.move_on_after(LOOK_AGAIN if self._is_missing else HEARTBEAT):
                await self._news.wait()

    def _is_stale(self) -> bool:
        if self._is_broken or self._connection != self._client.connections:
            return True
        if self._is_missing:
            return True
        return self._clock() - self._heard > HEARTBEAT * MISSED

    async def _begin(self) -> None:
        """Make a new consumer; while its stream is missing, it is like an empty one."""
        while True:
            while not self._client.is_connected:
                await self._news.wait()
            try:
                return await self._make_consumer()
            except (BrokerAway, NoResponders, jetstream.ApiError):
                await anyio.sleep(jetstream.TRY_AGAIN)

    async def _make_consumer(self) -> None:
        is_known_to_be_missing, self._is_missing = self._is_missing, False
        self._remove_consumer()
        self._connection = self._client.connections
        inbox = self._client.new_inbox()
        self._inbox = await self._client.subscribe(inbox, self._on_message)
        name = inbox.rpartition(".")[2]
        config = {
            "deliver_policy": "last_per_subject",
            "deliver_subject": inbox,
            "ack_policy": "none",
            "max_deliver": 1,
            "flow_control": True,
            "idle_heartbeat": HEARTBEAT * jetstream.SECOND,
            "mem_storage": True,
            "num_replicas": 1,
            **({} if self._since is None else _heads_since(self._since)),
        }
        self._records, self._flow, self._taken = [], [], 0
        self._is_broken = self._is_complete = self._is_told = False
        self._heard = self._clock()
        self._consumer = name  # one that is not answered in time may be made nevertheless
        try:
            answer = await self._maker.make(name, config)
        except jetstream.ApiError as exc:
            self._consumer = ""
            if exc.number != jetstream.STREAM_NOT_FOUND:
                raise
            self._is_complete, self._is_told = True, is_known_to_be_missing
            self._is_missing = True
            return
        # Otherwise the last one of them says so.
        if not (answer.get("num_pending") or answer["delivered"]["consumer_seq"]):
            self._is_complete = True

    def _on_message(self, message: Message) -> None:
        self._heard = self._clock()
        if message.status == "100":
            if message.reply:  # flow control
                self._flow.append(message.reply)
            elif stalled := message.headers.get("Nats-Consumer-Stalled"):
                self._flow.append(stalled)
            elif int(message.headers.get("Nats-Last-Consumer", self._taken)) > self._taken:
                self._is_broken = True
            elif self._since is None or self._is_complete:
                return
            else:  # the rest was removed before it was delivered
                self._is_complete = True
        elif message.status:
            self._is_broken = True
        else:
            sequence, number, pending = delivery(message.reply)
            if number != self._taken + 1:
                self._is_broken = True
            elif not self._is_broken:
                self._taken = number
                data = message.data if self._since is None else _head_of(message)
                self._records.append(BrokerRecord(message.subject, data, sequence))
                if not pending:
                    self._is_complete = True
        self._news.notify()

    def close(self) -> None:
        """Get no more changes."""
        self._client.to_notify.discard(self._news)
        self._remove_consumer()

    def _remove_consumer(self) -> None:
        if self._inbox is not None:
            self._inbox.close()
            self._inbox = None
        if self._consumer:
            self._client.publish(f"$JS.API.CONSUMER.DELETE.{self._stream}.{self._consumer}", b"")
            self._consumer = ""


def _heads_since(time: int) -> dict[str, object]:
    """Return the settings of a consumer that delivers the heads of records since a time."""
    begin = {"deliver_policy": "all"}
    if time:
        text = datetime.fromtimestamp(time // jetstream.SECOND, UTC).isoformat()
        begin = {"deliver_policy": "by_start_time", "opt_start_time": text}
    return {**begin, "headers_only": True}


def _head_of(message: Message) -> bytes:
    """Return the head of a record; empty if it has none that can be read."""
    try:
        return base64.b64decode(message.headers.get(HEAD, ""), validate=True)
    except ValueError:
        return b""


def delivery(reply: str) -> tuple[int, int, int]:
    """Return the sequence of a record, its number at the consumer, and how many are to come.

    They are in the subject for its acknowledgement, in the middle if there is an account in it.
    """
    tokens = reply.split(".")
    sequence, number, _, pending = tokens[5:9] if len(tokens) < 11 else tokens[7:11]
    return int(sequence), int(number), int(pending)


@asynccontextmanager
async def watch_records(
    client: NatsClient, stream: str, subject: str, since: int | None = None
) -> AsyncGenerator[RecordWatch, None]:
    """Watch the records of a subject, or with `since` their heads, while the block lasts.

    Raises:
        BrokerAway: There is no connection.
    """
    if not client.is_connected:
        raise BrokerAway(f"there is no connection to {client.url}")
    watch = RecordWatch(client, stream, subject, since)
    try:
        yield watch
    finally:
        watch.close()


class NoteQueue:
    """The notes of one subject."""

    def __init__(self, client: NatsClient, subject: str) -> None:
        self._client = client
        self._stream = stream_of_note(subject)
        self._maker = _ConsumerMaker(client, self._stream, subject)
        self._consumer = "_".join(subject.split(".")[2:])
        self._connection = 0  # the one on which the consumer is known to be there
        self._found: deque[Message] = deque()
        self._is_answered = True
        self._news = Notifier()

    async def notes(self) -> AsyncGenerator[Note, None]:
        """Take the notes, forever."""
        inbox = self._client.new_inbox()
        subscription = None
        self._client.to_notify.add(self._news)
        try:
            while True:
                if not self._client.is_connected:
                    await self._news.wait()
                    continue
                try:
                    if subscription is None:
                        subscription = await self._client.subscribe(inbox, self._on_message)
                    await self._take(inbox)
                except (BrokerAway, NoResponders, jetstream.ApiError):
                    self._connection = 0
                    await anyio.sleep(jetstream.TRY_AGAIN)
                while self._found:
                    yield self._note(self._found.popleft())
        finally:
            self._client.to_notify.discard(self._news)
            if subscription is not None:
                subscription.close()
            for message in self._found:
                self._client.publish(message.reply, b"-NAK")

    async def _take(self, inbox: str) -> None:
        """Ask for a note, and wait for the answer."""
        if self._connection != self._client.connections:
            connection = self._client.connections
            await self._make_consumer()
            self._connection = connection
        self._is_answered = False
        asked = {"batch": 1, "expires": ASKED_FOR * jetstream.SECOND}
        subject = f"$JS.API.CONSUMER.MSG.NEXT.{self._stream}.{self._consumer}"
        self._client.publish(subject, msgspec.json.encode(asked), inbox)
        with anyio.move_on_after(ASKED_FOR + LATENESS):
            while not (self._found or self._is_answered):
                if self._connection != self._client.connections:
                    return
                await self._news.wait()

    async def _make_consumer(self) -> None:
        """Make the consumer, if it is not there."""
        config = {
            "durable_name": self._consumer,
            "ack_policy": "explicit",
            "ack_wait": ACK_WAIT * jetstream.SECOND,
            "max_deliver": -1,
            "max_ack_pending": -1,
        }
        await self._maker.make(self._consumer, config)

    def _on_message(self, message: Message) -> None:
        if not message.status:
            self._found.append(message)
        else:
            self._is_answered = True
            if message.status not in ("404", "408"):  # the consumer, or its leader, is gone
                self._connection = 0
        self._news.notify()

    def _note(self, message: Message) -> Note:
        return Note(message.data, lambda: self._client.publish(message.reply, b"+ACK"))

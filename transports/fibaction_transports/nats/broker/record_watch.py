"""`RecordWatch`: the records of a subject of a stream, and then each change.

Theory of operation
-------------------

A consumer of JetStream delivers the newest record of each subject, and then all new ones, to an
inbox of this client. It is kept in the memory of one broker, so it is gone after a restart of that
one. It counts what it delivers; a number that is left out is a gap. Nothing of this is repaired in
place: after a gap, after heartbeats that did not come, and after each reconnection, there is a new
consumer and a new inbox, and all records come again.

In a cluster the consumer may be at a broker that lags: what was written a moment before may come
after the end of the first records, as a change.

The broker asks now and then whether what it has delivered was taken (flow control); it is told so
when `next` has returned it. So a reader that is slow holds the broker back, and not the memory.
"""

from __future__ import annotations

import base64
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from datetime import UTC, datetime

import anyio
import msgspec

from fibaction.border.abc import Notifier
from fibaction_transports.nats.broker import jetstream
from fibaction_transports.nats.broker.answers import RawMessage
from fibaction_transports.nats.broker.broker import (
    BrokerAway,
    BrokerRecord,
    BrokerSubscription,
    BrokerWatch,
    NoResponders,
)
from fibaction_transports.nats.broker.client import NatsClient

HEARTBEAT = 2
"""Seconds between heartbeats of a consumer that has nothing to deliver."""
HEAD = "Fibaction-Head"
"""The header with the head of a record, in base64."""
MISSED = 2.5
"""A consumer is gone after so many heartbeats without a message."""
LOOK_AGAIN = 1.0
"""Seconds until a stream that is missing is looked for again."""


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
        self._subject = subject
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
        return anyio.current_time() - self._heard > HEARTBEAT * MISSED

    async def _begin(self) -> None:
        """Make a new consumer; while its stream is missing, it is like an empty one."""
        patience = jetstream.INFO_TIMEOUT
        while True:
            while not self._client.is_connected:
                await self._news.wait()
            try:
                return await self._make_consumer(patience)
            except (BrokerAway, NoResponders, jetstream.ApiError):
                # Brokers without a leader do not answer: the next request may find one.
                patience = min(2 * patience, jetstream.API_TIMEOUT)
                await anyio.sleep(jetstream.TRY_AGAIN)

    async def _make_consumer(self, patience: float) -> None:
        is_known_to_be_missing, self._is_missing = self._is_missing, False
        self._remove_consumer()
        self._connection = self._client.connections
        inbox = self._client.new_inbox()
        self._inbox = await self._client.subscribe(inbox, self._on_message)
        name = inbox.rpartition(".")[2]
        config = {
            "name": name,
            "deliver_policy": "last_per_subject",
            "deliver_subject": inbox,
            "filter_subject": self._subject,
            "ack_policy": "none",
            "max_deliver": 1,
            "flow_control": True,
            "idle_heartbeat": HEARTBEAT * jetstream.SECOND,
            "mem_storage": True,
            "num_replicas": 1,
            **({} if self._since is None else _heads_since(self._since)),
        }
        body = msgspec.json.encode({"stream_name": self._stream, "config": config})
        self._records, self._flow, self._taken = [], [], 0
        self._is_broken = self._is_complete = self._is_told = False
        self._heard = anyio.current_time()
        api = f"CONSUMER.CREATE.{self._stream}.{name}.{self._subject}"
        self._consumer = name  # one that is not answered in time may be made nevertheless
        try:
            answer = await jetstream.call(self._client, api, body, patience)
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

    def _on_message(self, message: RawMessage) -> None:
        self._heard = anyio.current_time()
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


def _head_of(message: RawMessage) -> bytes:
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

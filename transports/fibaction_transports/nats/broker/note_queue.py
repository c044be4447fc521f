"""`NoteQueue`: takes the notes of a subject, one after the other.

Each subject has one consumer, which all workers share; it is kept as long as its stream. A worker
asks it for one note, and gets it when there is one. A worker that is gone has its note come again
to another one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import AsyncGenerator

import anyio
import msgspec

from fibaction.border.abc import Notifier
from fibaction_transports.nats.broker import jetstream
from fibaction_transports.nats.broker.answers import RawMessage
from fibaction_transports.nats.broker.broker import BrokerAway, NoResponders, Note
from fibaction_transports.nats.broker.client import NatsClient
from fibaction_transports.nats.names import stream_of_note

ACK_WAIT = 5
"""Seconds after which a note that is not done comes again."""
ASKED_FOR = 5
"""Seconds for which a consumer remembers that it was asked for a note."""
PATIENCE = 1.0
"""Seconds that its answer may be late."""


class NoteQueue:
    """The notes of one subject."""

    def __init__(self, client: NatsClient, subject: str) -> None:
        self._client = client
        self._subject = subject
        self._stream = stream_of_note(subject)
        self._consumer = "_".join(subject.split(".")[2:])
        self._connection = 0  # the one on which the consumer is known to be there
        self._found: deque[RawMessage] = deque()
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
        with anyio.move_on_after(ASKED_FOR + PATIENCE):
            while not (self._found or self._is_answered):
                if self._connection != self._client.connections:
                    return
                await self._news.wait()

    async def _make_consumer(self) -> None:
        """Make the consumer, if it is not there."""
        config = {
            "name": self._consumer,
            "durable_name": self._consumer,
            "filter_subject": self._subject,
            "ack_policy": "explicit",
            "ack_wait": ACK_WAIT * jetstream.SECOND,
            "max_deliver": -1,
            "max_ack_pending": -1,
        }
        body = msgspec.json.encode({"stream_name": self._stream, "config": config})
        api = f"CONSUMER.CREATE.{self._stream}.{self._consumer}.{self._subject}"
        await jetstream.call(self._client, api, body)

    def _on_message(self, message: RawMessage) -> None:
        if not message.status:
            self._found.append(message)
        else:
            self._is_answered = True
            if message.status not in ("404", "408"):  # the consumer, or its leader, is gone
                self._connection = 0
        self._news.notify()

    def _note(self, message: RawMessage) -> Note:
        return Note(message.data, lambda: self._client.publish(message.reply, b"+ACK"))

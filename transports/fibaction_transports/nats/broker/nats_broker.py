"""`NatsBroker`: a `Broker` on JetStream."""

from __future__ import annotations

import base64
import math
from collections.abc import AsyncGenerator
from contextlib import AbstractAsyncContextManager, asynccontextmanager, suppress
from typing import Any

import anyio
import msgspec

from fibaction.border.event_loop import Background
from fibaction.words.goal_query import GoalHistory
from fibaction_transports.nats.broker import jetstream
from fibaction_transports.nats.broker.answers import ACK_TIMEOUT
from fibaction_transports.nats.broker.broker import (
    Broker,
    BrokerAway,
    BrokerRecord,
    BrokerStream,
    BrokerWatch,
    Message,
    NoResponders,
    Note,
    PutError,
    PutFailure,
    Stored,
)
from fibaction_transports.nats.broker.client import NatsClient
from fibaction_transports.nats.broker.consumers import HEAD, NoteQueue, watch_records
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.settings import FleetSettings

HEADERS = 2**10
"""Bytes of a message that are left for its headers, at most."""
EXPECTED = "Nats-Expected-Last-Subject-Sequence"
"""The header of a write with the sequence that it replaces."""
FIRST_PAUSE, LONGEST_PAUSE = 0.02, 1.0
"""Seconds until a note is added again that the broker has not taken."""


class NatsBroker(NatsClient, Broker):
    """A connection to brokers of NATS with JetStream."""

    def __init__(self, settings: FleetSettings) -> None:
        super().__init__(settings)
        self._tasks: Any = None
        self.brokers = 1
        self.max_record = 0

    async def request(self, subject: str, data: bytes, timeout: float) -> bytes:
        return (await self.answer(subject, data, timeout)).data

    # Records

    async def create_streams(
        self,
        names: FleetNames,
        *,
        replicas: int = 0,
        has_keys: bool = False,
        history: GoalHistory | None = None,
    ) -> None:
        brokers = self.brokers
        await jetstream.create_streams(self, names, replicas, brokers, has_keys=has_keys)
        if history is not None:
            await jetstream.create_history(self, names, history, replicas, brokers)

    async def find_stream(self, stream: str) -> BrokerStream | None:
        return await jetstream.find_stream(self, stream)

    def put(
        self,
        subject: str,
        data: bytes,
        *,
        expected: int,
        ttl: float | None = None,
        head: bytes = b"",
        then: Stored,
    ) -> None:
        if len(data) > self.max_record:
            text = f"{len(data)} bytes are more than the {self.max_record} that the broker takes"
            error = PutError(PutFailure.TOO_LARGE, text)
            self.soon(lambda: then(error))
            return
        headers = {EXPECTED: str(expected)}
        if not data:
            headers["Nats-Marker-Reason"] = "Remove"
            ttl = jetstream.MARKER_TTL if ttl is None else ttl
        if ttl is not None and ttl < math.inf:
            headers["Nats-TTL"] = str(max(1, math.ceil(ttl)))
        if head:
            headers[HEAD] = base64.b64encode(head).decode()
        self.ask(subject, data, headers, lambda answer: then(_outcome(answer)))

    async def get(self, stream: str, subject: str) -> BrokerRecord | None:
        if self.brokers > 1:
            return await self._get_from_leader(stream, subject)
        try:
            answer = await self.answer(f"$JS.API.DIRECT.GET.{stream}.{subject}", b"", ACK_TIMEOUT)
        except NoResponders:  # it is missing, or was made just now
            return await self._get_from_leader(stream, subject)
        if answer.status == "404":
            return None
        if answer.status:
            raise BrokerAway(f"the stream {stream} does not answer: {answer.status}")
        return BrokerRecord(subject, answer.data, int(answer.headers["Nats-Sequence"]))

    async def _get_from_leader(self, stream: str, subject: str) -> BrokerRecord | None:
        """Return the newest record. To direct requests, brokers answer that may have an old one."""
        asked = msgspec.json.encode({"last_by_subj": subject})
        try:
            answer = await jetstream.call(self, f"STREAM.MSG.GET.{stream}", asked)
        except jetstream.ApiError as exc:
            if exc.code == 404:
                return None
            raise BrokerAway(f"the stream {stream} does not answer: {exc}") from exc
        except NoResponders as exc:
            raise BrokerAway("JetStream does not answer") from exc
        found = answer["message"]
        return BrokerRecord(subject, base64.b64decode(found.get("data", "")), found["seq"])

    def watch(
        self, stream: str, subject: str, *, heads_since: int | None = None
    ) -> AbstractAsyncContextManager[BrokerWatch]:
        return watch_records(self, stream, subject, heads_since)

    # Notes

    def add_note(self, subject: str, data: bytes) -> None:
        self._add_note(subject, data, FIRST_PAUSE)

    def _add_note(self, subject: str, data: bytes, pause: float) -> None:
        def then(answer: Message | None) -> None:
            if isinstance(_outcome(answer), PutError):
                self._tasks.start_soon(again)

        async def again() -> None:
            await anyio.sleep(pause)
            self._add_note(subject, data, min(2 * pause, LONGEST_PAUSE))

        self.ask(subject, data, None, then)

    def notes(self, subject: str) -> AsyncGenerator[Note, None]:
        return NoteQueue(self, subject).notes()

    # Life

    async def check(self) -> None:
        """Check that the broker has all that a fleet needs.

        Raises:
            TransportError: It is too old, or has no JetStream.
        """
        info = self.info
        jetstream.check_version(self.url, info.version)
        await jetstream.check_account(self)
        self.max_record = info.max_payload - HEADERS
        if info.cluster:
            self.brokers = max(len(info.connect_urls), 2)

    def start(self, tasks: Any) -> None:
        """Begin to connect again whenever the connection is lost."""
        self._tasks = tasks
        for task in (self.expire, self.keep_connected):
            tasks.start_soon(task)


def _outcome(answer: Message | None) -> int | PutError:
    """Return the sequence of a stored record, or the error."""
    if answer is None:
        return PutError(PutFailure.UNKNOWN, f"the broker did not answer within {ACK_TIMEOUT:g} s")
    if answer.status:
        return PutError(PutFailure.UNKNOWN, "the stream does not answer")
    return jetstream.outcome(answer.data)


@asynccontextmanager
async def open_broker(settings: FleetSettings) -> AsyncGenerator[NatsBroker, None]:
    """Connect to the brokers for as long as the block lasts.

    Raises:
        ServerNotFound: No broker answers.
        AuthenticationFailed: A broker does not let this client in.
        TransportError: The broker is too old, or has no JetStream.
    """
    broker = NatsBroker(settings)
    await broker.connect()
    async with Background() as tasks:
        try:
            broker.start(tasks)
            with suppress(BrokerAway):
                await broker.flush()
            await broker.check()
            yield broker
        finally:
            await broker.close()

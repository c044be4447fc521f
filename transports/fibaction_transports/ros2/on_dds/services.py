"""The ends of services over RTPS: a topic with requests, and one with replies.

Theory of operation
-------------------

Servers of several vendors may serve one service, and clients of several may call it. A request goes
to each server in the way of its vendor: one sample for all servers of one way,
or one for each server if there are both ways. A reply goes to the readers of its client only, which
other readers are told by a GAP: a reader of Fast DDS cannot take the longer replies for Cyclone.

The middlewares write the identity of a request, which is its client and its number there, in two
ways, and each reads its own only. Fast DDS has it in the inline QoS: a request names the reader of
its client's replies, and a reply the same reader and the number of the request's sample. Cyclone
DDS has a header of 16 bytes ahead of the message, in requests and replies alike, which the server
returns as it is. Our own ends write it as Fast DDS does.

A client that waits for an answer asks the writers of replies for what it may have missed: after
`FIRST_ASK` seconds, and then after twice the time each, up to `LONGEST_ASK`. Without this a lost
answer of Fast DDS comes after 3 s, with its next heartbeat.
"""

from __future__ import annotations

import struct
from collections import OrderedDict, deque
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import anyio

from fibaction.border.abc import Notifier
from fibaction.border.event_loop import loop_clock
from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import ConnectionLost, LimitReached, ProtocolError
from fibaction_transports.ros2.node.parts import (
    AnswerSink,
    ErrorSink,
    RequestSink,
    ServiceCaller,
    ServiceProvider,
)
from fibaction_transports.ros2.without_ros.messages.message_type import MessageType, ServiceType
from fibaction_transports.rtps.endpoints.reader import DataReader
from fibaction_transports.rtps.endpoints.sample import Sample
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.messages.ids import CYCLONE_DDS, OWN_VENDOR, PREFIX_SIZE, Guid
from fibaction_transports.rtps.messages.layout import ENCAPSULATION
from fibaction_transports.rtps.messages.parameters import (
    FAST_DDS_RELATED_SAMPLE_IDENTITY,
    RELATED_SAMPLE_IDENTITY,
    SampleIdentity,
    identity_value,
)
from fibaction_transports.rtps.network import ParticipantNetwork

UNKNOWN_NUMBER: Final = -(2**32)
"""The number in the identity of a request of Fast DDS: that of the sample itself counts."""
CLIENT_SIZE: Final = 8
"""Bytes of the ID of a client in a header."""
_HEADER = struct.Struct("<8sq")


def identity_items(identity: SampleIdentity) -> list[tuple[int, bytes]]:
    """Return an identity as inline QoS."""
    value = identity_value(identity)
    return [(FAST_DDS_RELATED_SAMPLE_IDENTITY, value), (RELATED_SAMPLE_IDENTITY, value)]


def identity_in(sample: Sample) -> SampleIdentity | None:
    """Return the identity in the inline QoS of a sample; None if there is none."""
    if sample.inline_qos is None:
        return None
    related = sample.inline_qos.identity(RELATED_SAMPLE_IDENTITY)
    if related is None:
        related = sample.inline_qos.identity(FAST_DDS_RELATED_SAMPLE_IDENTITY)
    return related


def header_of(client: bytes, number: int) -> bytes:
    """Return the header of a request; `client` has 8 bytes."""
    return _HEADER.pack(client, number)


def number_in(header: bytes) -> tuple[bytes, int]:
    """Return the client and the number in a header."""
    client, number = _HEADER.unpack(header)
    return client, number


def with_header(header: bytes, payload: bytes) -> bytes:
    """Return a payload with a header ahead of its message."""
    return payload[:ENCAPSULATION] + header + payload[ENCAPSULATION:]


def split_header(payload: bytes) -> tuple[bytes, bytes] | None:
    """Return the header of a payload, and the payload without it; None if it is too short."""
    end = ENCAPSULATION + _HEADER.size
    if len(payload) < end:
        return None
    return payload[ENCAPSULATION:end], payload[:ENCAPSULATION] + payload[end:]


def client_of(reader: Guid) -> bytes:
    """Return the ID of a client in headers, made of the GUID of its reader of replies.

    A server sends replies to all clients, so each needs an ID of its own: the first random bytes of
    the participant's GUID, and the number of the reader in it.
    """
    random, number = reader.prefix[len(OWN_VENDOR) :], reader.entity[:-1]
    return random[: CLIENT_SIZE - 2] + number[-2:]


FIRST_ASK, LONGEST_ASK = 0.03, 2.0
"""Seconds after which a client asks for an answer: the first time, and at most."""
OPEN_REQUESTS = 10_000
"""Requests whose answers a client still knows; then the oldest is forgotten."""
ANSWERED_REQUESTS = 256
"""Answered requests that a client still knows: other servers of the name may answer them, too."""

logger = clean_logger("fibaction.ros2")


class ServiceEnds:
    """The writer and the reader of one end of a service."""

    def __init__(self, network: ParticipantNetwork, writer: DataWriter, reader: DataReader) -> None:
        self.network = network
        self.writer = writer
        self.reader = reader

    def uses_header(self, guid: Guid) -> bool:
        """Return whether the participant of another end has identities in headers."""
        return self.network.participant.vendor_of(guid[:PREFIX_SIZE]) == CYCLONE_DDS


class DdsCaller(ServiceCaller):
    """A client of a service."""

    def __init__(
        self,
        ends: ServiceEnds,
        service_type: ServiceType,
        take: AnswerSink,
        take_unreadable: ErrorSink | None,
    ) -> None:
        self.ends = ends
        """The writer of requests, and the reader of answers."""
        self._encode = service_type.Request.codec.encode
        self._decode = service_type.Response.codec.decode
        self._take = take
        self._take_unreadable = take_unreadable
        self._client = client_of(ends.reader.guid)
        self._inline = identity_items(SampleIdentity(ends.reader.guid, UNKNOWN_NUMBER))
        """The identity of each request without a header."""
        self._calls = 0
        self._open: OrderedDict[int, None] = OrderedDict()
        """The calls that have no answer yet."""
        self._of_sample: OrderedDict[int, int] = OrderedDict()
        """The calls, by the numbers of their samples."""
        self._answered: deque[int] = deque()
        """The samples that are answered, in the order of the answers."""
        self._is_closed = False
        self._sent = Notifier()
        self._pause = FIRST_ASK
        self._time = loop_clock()
        self._due = self._time()

    def send(self, request: Any) -> int:
        self._calls += 1
        payload = self._encode(request)
        try:
            self._write(self._calls, payload)
        except LimitReached as exc:
            raise ConnectionLost(f"{self.ends.writer.topic} is not read: {exc}") from exc
        _put(self._open, self._calls, None)
        self._pause = FIRST_ASK
        self._due = self._time() + self._pause
        self._sent.notify()
        return self._calls

    def _write(self, call: int, payload: bytes) -> None:
        servers = self.ends.writer.matched
        by_header = set(filter(self.ends.uses_header, servers))
        if by_header and len(by_header) < len(servers):
            for server in servers:
                self._write_to(server, call, payload, in_header=server in by_header)
        else:
            self._write_to(None, call, payload, in_header=bool(by_header))

    def _write_to(self, server: Guid | None, call: int, payload: bytes, *, in_header: bool) -> None:
        """Send a request to one server, or to all of them."""
        ends = self.ends
        inline: Sequence[tuple[int, bytes]] = ()
        if in_header:
            payload = with_header(header_of(self._client, call), payload)
        else:
            inline = self._inline
        number = ends.network.write(ends.writer, payload, inline_qos=inline, only_to=server)
        if not in_header:
            _put(self._of_sample, number, call)

    def is_available(self) -> bool:
        # A server that has not found the reader yet would lose the first answers.
        ends = self.ends
        for reader in ends.writer.matched:
            for writer in ends.reader.confirmed_writers:
                if reader[:PREFIX_SIZE] == writer[:PREFIX_SIZE]:
                    return True
        return False

    def forget(self, number: int) -> None:
        self._open.pop(number, None)

    def receive(self, sample: Sample) -> None:
        """Take an answer, which may be for another client."""
        found = self._call_of(sample)
        if found is None:
            return
        call, payload = found
        self._open.pop(call, None)
        try:
            response = self._decode(payload)
        except ProtocolError as exc:
            logger.error("an answer on %s cannot be read: %s", self.ends.reader.topic, exc)
            if self._take_unreadable is not None:
                self._take_unreadable(exc)
        else:
            self._take(call, response)

    def _call_of(self, sample: Sample) -> tuple[int, bytes] | None:
        if self.ends.uses_header(sample.writer):
            parts = split_header(sample.payload)
            if parts is None:
                return None
            client, call = number_in(parts[0])
            return (call, parts[1]) if client == self._client else None
        identity = identity_in(sample)
        if identity is None or identity.writer != self.ends.reader.guid:
            return None
        known = self._of_sample.get(identity.number)
        if known is None:
            return None
        participant = sample.writer[:PREFIX_SIZE]
        self.ends.writer.receive_answer(participant, identity.number, self._time())
        self._answered.append(identity.number)
        if len(self._answered) > ANSWERED_REQUESTS:
            self._of_sample.pop(self._answered.popleft(), None)
        return known, sample.payload

    def close(self) -> None:
        """Wait for no answer any more."""
        self._is_closed = True
        self._open.clear()
        self._sent.notify()

    async def ask(self) -> None:
        """Ask for answers that may have been lost, until closed."""
        while not self._is_closed:
            if not self._open:
                await self._sent.wait()
                continue
            await anyio.sleep_until(self._due)
            if self._time() < self._due or not self._open:
                continue
            self.ends.reader.ask(self._time())
            self.ends.network.settle()
            self._pause = min(2 * self._pause, LONGEST_ASK)
            self._due = self._time() + self._pause


class RequestHeader(NamedTuple):
    """The address of an answer, and the identity of its request."""

    client: Guid
    """The writer of the request."""
    identity: SampleIdentity | None
    """The client's reader of replies, and the number of the request; None with a header."""
    header: bytes
    """The header of the request; empty if it has none."""


class DdsProvider(ServiceProvider):
    """A server of a service."""

    def __init__(self, ends: ServiceEnds, service_type: ServiceType, take: RequestSink) -> None:
        self.ends = ends
        self._request: MessageType = service_type.Request
        self._encode = service_type.Response.codec.encode
        self._take = take

    def receive(self, sample: Sample) -> None:
        """Take a request."""
        found = self._header_of(sample)
        if found is None:
            logger.error("a request on %s does not name its client", self.ends.reader.topic)
            return
        header, payload = found
        try:
            request = self._request.codec.decode(payload)
        except ProtocolError as exc:
            logger.error("a request on %s cannot be read: %s", self.ends.reader.topic, exc)
        else:
            self._take(header, request)

    def _header_of(self, sample: Sample) -> tuple[RequestHeader, bytes] | None:
        if self.ends.uses_header(sample.writer):
            parts = split_header(sample.payload)
            return parts and (RequestHeader(sample.writer, None, parts[0]), parts[1])
        identity = identity_in(sample)
        if identity is None:
            return None
        related = SampleIdentity(identity.writer, sample.number)
        return RequestHeader(sample.writer, related, b""), sample.payload

    def answer(self, header: Any, response: Any) -> bool:
        readers = self._readers_of(header)
        payload = self._encode(response)
        if header.header:
            payload = with_header(header.header, payload)
        inline = () if header.identity is None else identity_items(header.identity)
        for reader in readers:
            self.ends.network.write(self.ends.writer, payload, inline_qos=inline, only_to=reader)
        return bool(readers)

    def _readers_of(self, header: RequestHeader) -> list[Guid]:
        """Return the readers of replies that a client has; none if they are not matched yet."""
        readers = self.ends.writer.matched
        if header.identity is not None:
            return [header.identity.writer] if header.identity.writer in readers else []
        # A header does not name the reader, so all of the client's participant get the answer.
        return [reader for reader in readers if reader.prefix == header.client.prefix]


def _put(table: OrderedDict[int, Any], key: int, value: Any) -> None:
    table[key] = value
    if len(table) > OPEN_REQUESTS:
        table.popitem(last=False)

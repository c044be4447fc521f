"""A participant of DDS, without I/O: datagrams in, datagrams and events out, time as an argument.

    participant = Participant(settings, now)
    participant.receive(datagram, address, now)       # as they arrive
    participant.handle_deadline(now)                  # at `next_deadline()`
    for datagram, address in participant.datagrams_to_send(): ...
    for event in participant.events(): ...

After each call that changes something, send what is to be sent, take the events, and ask for the
next deadline. Times are seconds of any clock that does not go back.

The network is not trusted: a datagram that breaks a rule or a limit is dropped and counted, and
never raises. RTPS has no authentication: every host that can send to the ports is a peer. What is
checked is the address: something in the name of a participant counts only from a host that it has
announced, and a participant is sent little before it has shown that it receives it (`budgets`). So
another host cannot end a participant or move its numbers, unless it forges source addresses; a
program of the same machine can do so to all participants of this machine.
Endpoints of the same participant do not match each other, unless `match_own` is called for each.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence

from msgspec import Struct

from fibaction_transports.rtps.discovery.endpoint_discovery import (
    EndpointData,
    EndpointDiscovery,
    Matcher,
    RemoteEndpoints,
)
from fibaction_transports.rtps.discovery.known_participants import (
    KnownParticipants,
    ParticipantData,
    RemoteParticipant,
)
from fibaction_transports.rtps.discovery.liveliness import Assertions, WriterLiveliness
from fibaction_transports.rtps.discovery.local_endpoints import BuiltinEndpoints, LocalEndpoints
from fibaction_transports.rtps.discovery.type_lookup import TypeLookup
from fibaction_transports.rtps.endpoints.reader import DataReader, EarlyHeartbeats
from fibaction_transports.rtps.endpoints.sample import Sample
from fibaction_transports.rtps.endpoints.shared import SharedParts
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.events import Event, SampleReceived
from fibaction_transports.rtps.limits import RtpsCounters, RtpsLimits
from fibaction_transports.rtps.messages.codec import read_packet
from fibaction_transports.rtps.messages.ids import (
    KEYLESS_READER,
    KEYLESS_WRITER,
    OWN_VENDOR,
    PARTICIPANT,
    PREFIX_SIZE,
    Address,
    Guid,
    udp_locator,
    user_entity,
)
from fibaction_transports.rtps.messages.layout import InvalidPacket
from fibaction_transports.rtps.qos import Qos
from fibaction_transports.rtps.router import MessageRouter


class ParticipantSettings(Struct, frozen=True, kw_only=True):
    """The settings of a participant."""

    discovery_addresses: tuple[Address, ...]
    """Addresses at which it receives discovery."""
    data_addresses: tuple[Address, ...]
    """Addresses at which it receives samples."""
    announce_to: tuple[Address, ...] = ()
    """Addresses to which it announces itself: a multicast group, or ports of other participants."""
    domain: int = 0
    name: str = "/"
    user_data: bytes = b"enclave=/;"
    lease: float = 20.0
    """Seconds after which others may forget it, if it is silent."""
    fragment_size: int = 63_000
    """Bytes of a sample that go into one datagram, from 256 to 63,000; larger samples are sent in
    fragments. On networks that lose much, a size below the MTU loses less with each datagram."""
    limits: RtpsLimits = RtpsLimits()

    def __post_init__(self) -> None:
        if not 256 <= self.fragment_size <= 63_000:
            raise ValueError(f"fragment size {self.fragment_size} is not between 256 and 63,000")


class Participant:
    """A participant of a domain of DDS, with its writers and readers."""

    def __init__(
        self, settings: ParticipantSettings, now: float, *, prefix: bytes | None = None
    ) -> None:
        """Begin to announce the participant; its prefix is random if none is given."""
        self.prefix = prefix or OWN_VENDOR + os.urandom(PREFIX_SIZE - len(OWN_VENDOR))
        self._events: list[Event] = []
        self._shared = SharedParts(
            self.prefix, settings.limits, settings.fragment_size, self._events.append
        )
        self.outbox = self._shared.outbox
        """The submessages that wait to be sent."""
        self._entities = 0
        self._is_closed = False
        self._local = LocalEndpoints()
        self._remote = RemoteEndpoints(settings.limits)
        self._early = early = EarlyHeartbeats(settings.limits)
        liveliness = WriterLiveliness(self._shared)
        self._participants = KnownParticipants(
            ParticipantData(
                prefix=self.prefix,
                name=settings.name,
                user_data=settings.user_data,
                lease=settings.lease,
                domain=settings.domain,
                discovery_locators=tuple(map(udp_locator, settings.discovery_addresses)),
                data_locators=tuple(map(udp_locator, settings.data_addresses)),
            ),
            [to for to in settings.announce_to if to not in settings.discovery_addresses],
            self._shared,
            on_found=self._participant_found,
            on_lost=self._participant_lost,
        )
        self._builtin = BuiltinEndpoints(
            self._local,
            self._shared,
            on_endpoint=self._endpoint_announced,
            on_assertion=liveliness.receive,
        )
        self._type_lookup = TypeLookup(self._local, self._shared)
        self._matcher = Matcher(
            self._local, self._remote, self._participants, early, liveliness, self._shared
        )
        self._discovery = EndpointDiscovery(
            self._builtin.publications,
            self._builtin.subscriptions,
            self._remote,
            self._matcher,
            self._shared,
        )
        self._assertions = Assertions(self._builtin.liveliness, self._local, self._shared)
        self._router = MessageRouter(
            self._local, self._participants, early, liveliness, self._shared
        )
        self._participants.on_announcement_due(now)

    @property
    def guid(self) -> Guid:
        """The identifier of the participant."""
        return Guid(self.prefix + PARTICIPANT)

    @property
    def counters(self) -> RtpsCounters:
        """Counts of what was received and left out."""
        return self._shared.counters

    @property
    def remote_participants(self) -> list[RemoteParticipant]:
        """The other participants."""
        return self._participants.all()

    @property
    def remote_endpoints(self) -> list[EndpointData]:
        """The endpoints of other participants, matched or not."""
        return self._remote.all()

    def count_remote_endpoints(self) -> int:
        """Return the number of the endpoints of other participants."""
        return len(self._remote)

    def remote_endpoints_on(self, topic: str) -> list[EndpointData]:
        """Return the endpoints that other participants have on a topic, matched or not."""
        return self._remote.on_topic(topic)

    def incomplete_participants(self, found_after: float, reader: DataReader) -> int:
        """Return the number of participants that were found after a time, and whose endpoints, or
        whose samples for a reader, have not all come.
        """
        lacking = {guid.prefix for guid in reader.writers if not reader.is_complete(guid)}
        recent = [one.data for one in self._participants.all() if one.found > found_after]
        return sum(one.prefix in lacking or not self._builtin.has_all(one) for one in recent)

    def vendor_of(self, prefix: bytes) -> bytes | None:
        """Return the vendor of another participant; None if it is not known."""
        return self._participants.vendors.get(prefix)

    def ask_types(self, prefix: bytes, type_ids: Sequence[bytes], now: float) -> int:
        """Ask another participant about types, as `TypeLookup.ask` describes."""
        return self._type_lookup.ask(prefix, type_ids, now)

    def create_writer(
        self, topic: str, type_name: str, qos: Qos, now: float, *, user_data: bytes = b""
    ) -> DataWriter:
        """Create a writer of a topic, and announce it. ROS puts the hash of the type into the user
        data.
        """
        guid = self._new_guid(KEYLESS_WRITER)
        writer = DataWriter(guid, topic, type_name, qos, self._shared)
        self._local.writers[guid.entity] = writer
        self._announce(writer, user_data, now)
        self._assertions.plan(now)
        return writer

    def create_reader(
        self, topic: str, type_name: str, qos: Qos, now: float, *, user_data: bytes = b""
    ) -> DataReader:
        """Create a reader of a topic, and announce it."""
        guid = self._new_guid(KEYLESS_READER)
        reader = DataReader(guid, topic, type_name, qos, self._shared, self._deliver)
        self._local.readers[guid.entity] = reader
        self._announce(reader, user_data, now)
        return reader

    def match_own(self, endpoint: DataWriter | DataReader, now: float) -> None:
        """Match an endpoint with the others of this participant, which exchange samples without the
        network.
        """
        self._matcher.match_own(endpoint, now)

    def remove(self, endpoint: DataWriter | DataReader, now: float) -> None:
        """Close a writer or reader, and tell others that it is gone; once is enough."""
        self._matcher.forget_local(endpoint)
        endpoint.close()
        is_writer = isinstance(endpoint, DataWriter)
        table = self._local.writers if is_writer else self._local.readers
        if table.pop(endpoint.guid.entity, None) is None:
            return
        self._discovery.withdraw(endpoint.guid, now)
        self._assertions.plan(now)

    def receive(self, datagram: bytes, address: Address, now: float) -> None:
        """Take a datagram from an address."""
        if self._is_closed:
            return
        self._shared.counters.datagrams += 1
        try:
            self._router.route(read_packet(datagram), address, now)
        except InvalidPacket:
            self._shared.counters.invalid += 1

    def next_deadline(self) -> float:
        """Return the time at which `handle_deadline` is to be called; infinity if at none."""
        return self._shared.timers.next()

    def handle_deadline(self, now: float) -> None:
        """Do what is due at this time; nothing if nothing is."""
        self._shared.timers.run(now)

    def datagrams_to_send(self) -> Iterator[tuple[bytes, Address]]:
        """Take the datagrams that are to be sent, with their addresses."""
        return self.outbox.datagrams()

    def events(self) -> list[Event]:
        """Take the events since the last call, in order."""
        events = self._events[:]
        self._events.clear()
        return events

    def close(self, now: float) -> None:
        """Tell others that this participant and its endpoints are gone; then send what is to be
        sent, for the last time.
        """
        if self._is_closed:
            return
        for writer in self._local.user_writers():
            self.remove(writer, now)
        for reader in self._local.user_readers():
            self.remove(reader, now)
        self._participants.leave()
        self._local.close()
        self._shared.timers.clear()
        self._is_closed = True

    def _new_guid(self, kind: int) -> Guid:
        self._entities += 1
        return Guid(self.prefix + user_entity(self._entities, kind))

    def _announce(self, endpoint: DataWriter | DataReader, user_data: bytes, now: float) -> None:
        data = EndpointData(
            guid=endpoint.guid,
            topic=endpoint.topic,
            type_name=endpoint.type_name,
            qos=endpoint.qos,
            user_data=user_data,
        )
        self._discovery.announce(data, now)
        self._matcher.match_local(endpoint, now)

    def _deliver(self, reader: Guid, sample: Sample, now: float) -> None:
        is_ended = sample.inline_qos is not None and sample.is_ended
        if sample.payload and not sample.is_key and not is_ended:
            self._events.append(SampleReceived(reader, sample))

    def _endpoint_announced(self, sample: Sample, now: float) -> None:
        self._discovery.receive(sample, now)

    def _participant_found(self, participant: RemoteParticipant, now: float) -> None:
        self._builtin.match(participant, now)
        self._type_lookup.match(participant, now)

    def _participant_lost(self, prefix: bytes, now: float) -> None:
        self._discovery.forget_participant(prefix, now)
        self._early.forget_participant(prefix)
        self._builtin.unmatch(prefix, now)
        self._type_lookup.unmatch(prefix, now)

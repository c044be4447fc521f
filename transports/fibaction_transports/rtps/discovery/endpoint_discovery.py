"""The announcements of endpoints (SEDP), those of others in a table, and which exchange samples."""

from __future__ import annotations

import math

import msgspec
from msgspec import Struct

from fibaction_transports.rtps.discovery.known_participants import KnownParticipants
from fibaction_transports.rtps.discovery.liveliness import WriterLiveliness
from fibaction_transports.rtps.discovery.local_endpoints import LocalEndpoints
from fibaction_transports.rtps.discovery.type_lookup import read_type_id
from fibaction_transports.rtps.endpoints.reader import DataReader, EarlyHeartbeats
from fibaction_transports.rtps.endpoints.sample import DISPOSED, Sample, StoredSample
from fibaction_transports.rtps.endpoints.shared import SharedParts
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.events import EndpointMatched, EndpointUnmatched, QosMismatch
from fibaction_transports.rtps.limits import RtpsLimits
from fibaction_transports.rtps.messages import parameters as pids
from fibaction_transports.rtps.messages.ids import PARTICIPANT, Guid, Locator
from fibaction_transports.rtps.messages.layout import InvalidPacket
from fibaction_transports.rtps.messages.parameters import Parameters, list_payload, read_list
from fibaction_transports.rtps.qos import Qos, mismatches, qos_items, read_qos


class EndpointData(Struct, frozen=True, kw_only=True):
    """An endpoint, as its participant announces it."""

    guid: Guid
    topic: str
    type_name: str
    qos: Qos
    user_data: bytes = b""
    type_id: bytes = b""
    """The ID of its type in XTypes, if it announces one."""
    locators: tuple[Locator, ...] = ()
    """Addresses of the endpoint itself; if there are none, those of its participant hold."""


def endpoint_payload(data: EndpointData) -> bytes:
    """Return the announcement of an endpoint."""
    items = [
        (pids.ENDPOINT_GUID, data.guid),
        (pids.PARTICIPANT_GUID, data.guid.prefix + PARTICIPANT),
        (pids.TOPIC_NAME, pids.text_value(data.topic)),
        (pids.TYPE_NAME, pids.text_value(data.type_name)),
        (pids.KEY_HASH, data.guid),
        *qos_items(data.qos),
        *pids.locator_items(pids.UNICAST_LOCATOR, data.locators),
    ]
    if data.user_data:
        items.append((pids.USER_DATA, pids.blob_value(data.user_data)))
    return list_payload(Parameters(tuple(items)))


def read_endpoint(parameters: Parameters, guid: Guid) -> EndpointData:
    """Read the announcement of the endpoint with this identifier.

    Raises:
        InvalidPacket: It has no topic or type, or a parameter is broken.
    """
    topic, type_name = parameters.text(pids.TOPIC_NAME), parameters.text(pids.TYPE_NAME)
    if not topic or not type_name:
        raise InvalidPacket("announcement of an endpoint has no topic or no type")
    try:
        qos = read_qos(parameters, is_writer=guid.is_writer)
    except ValueError as error:
        raise InvalidPacket(f"quality of service of topic {topic!r}: {error}") from error
    return EndpointData(
        guid=guid,
        topic=topic,
        type_name=type_name,
        qos=qos,
        user_data=parameters.blob(pids.USER_DATA) or b"",
        type_id=read_type_id(parameters),
        locators=tuple(parameters.locators(pids.UNICAST_LOCATOR)),
    )


class RemoteEndpoints:
    """A table of the endpoints that other participants have announced."""

    def __init__(self, limits: RtpsLimits) -> None:
        self._limits = limits
        self._of: dict[bytes, dict[Guid, EndpointData]] = {}
        self._topics: dict[str, dict[Guid, EndpointData]] = {}
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def get(self, guid: Guid) -> EndpointData | None:
        """Return an endpoint; None if it is not known."""
        return self._of.get(guid.prefix, {}).get(guid)

    def all(self) -> list[EndpointData]:
        """Return all endpoints."""
        return [data for of_one in self._of.values() for data in of_one.values()]

    def on_topic(self, topic: str) -> list[EndpointData]:
        """Return the endpoints of a topic."""
        return list(self._topics.get(topic, {}).values())

    def add(self, data: EndpointData) -> bool:
        """Add an endpoint that is not known; return False if there are too many."""
        of_one = self._of.get(data.guid.prefix, {})
        limits = self._limits
        if self._count >= limits.endpoints or len(of_one) >= limits.endpoints_of_one:
            return False
        self._of.setdefault(data.guid.prefix, of_one)[data.guid] = data
        self._topics.setdefault(data.topic, {})[data.guid] = data
        self._count += 1
        return True

    def remove(self, guid: Guid) -> EndpointData | None:
        """Remove an endpoint, and return it; None if it is not known."""
        of_one = self._of.get(guid.prefix, {})
        data = of_one.pop(guid, None)
        if data is None:
            return None
        if not of_one:
            del self._of[guid.prefix]
        of_topic = self._topics[data.topic]
        del of_topic[guid]
        if not of_topic:
            del self._topics[data.topic]
        self._count -= 1
        return data

    def of_participant(self, prefix: bytes) -> list[Guid]:
        """Return the endpoints of a participant."""
        return list(self._of.get(prefix, ()))


class Matcher:
    """Matches the endpoints of this participant with those of others."""

    def __init__(
        self,
        local: LocalEndpoints,
        remote: RemoteEndpoints,
        participants: KnownParticipants,
        early: EarlyHeartbeats,
        liveliness: WriterLiveliness,
        shared: SharedParts,
    ) -> None:
        self._local = local
        self._remote = remote
        self._participants = participants
        self._early = early
        self._liveliness = liveliness
        self._shared = shared

    def match_local(self, endpoint: DataWriter | DataReader, now: float) -> None:
        """Match a new endpoint of this participant with those of others."""
        for data in self._remote.on_topic(endpoint.topic):
            if data.guid.is_reader == isinstance(endpoint, DataWriter):
                self._match(endpoint, data, now)

    def match_own(self, endpoint: DataWriter | DataReader, now: float) -> None:
        """Match a new endpoint with the others of this participant."""
        if isinstance(endpoint, DataWriter):
            pairs = [(endpoint, reader) for reader in self._local.user_readers()]
        else:
            pairs = [(writer, endpoint) for writer in self._local.user_writers()]
        for writer, reader in pairs:
            is_same = (writer.topic, writer.type_name) == (reader.topic, reader.type_name)
            if is_same and not mismatches(writer.qos, reader.qos):
                writer.match_own(reader, now)

    def match_remote(self, data: EndpointData, now: float) -> None:
        """Match a new endpoint of another participant with those of this one."""
        for endpoint in self._local_opposites(data.guid):
            if endpoint.topic == data.topic:
                self._match(endpoint, data, now)

    def unmatch_remote(self, guid: Guid, now: float) -> None:
        """End the matches of an endpoint of another participant."""
        for endpoint in self._local_opposites(guid):
            if isinstance(endpoint, DataWriter):
                was_matched = endpoint.unmatch(guid, now)
            else:
                was_matched = endpoint.unmatch(guid)
                self._liveliness.forget(endpoint.guid, guid)
            if was_matched:
                self._shared.emit(EndpointUnmatched(endpoint.guid, guid))

    def forget_local(self, endpoint: DataWriter | DataReader) -> None:
        """Follow the writers of an endpoint of this participant no longer: it is removed."""
        if isinstance(endpoint, DataReader):
            for writer in endpoint.writers:
                self._liveliness.forget(endpoint.guid, writer)

    def _local_opposites(self, guid: Guid) -> list[DataWriter] | list[DataReader]:
        if guid.is_reader:
            return self._local.user_writers()
        return self._local.user_readers()

    def _is_full(self, endpoint: DataWriter | DataReader, prefix: bytes) -> bool:
        """Return whether an endpoint is matched with as many of one participant as it may be."""
        matched = endpoint.readers if isinstance(endpoint, DataWriter) else endpoint.writers
        most = self._shared.limits.matches_of_one
        return len(matched) >= most and sum(1 for g in matched if g.prefix == prefix) >= most

    def _match(self, endpoint: DataWriter | DataReader, data: EndpointData, now: float) -> None:
        is_writer = isinstance(endpoint, DataWriter)
        pair = (endpoint.qos, data.qos) if is_writer else (data.qos, endpoint.qos)
        reasons = mismatches(*pair)
        if endpoint.type_name != data.type_name:
            reasons.insert(0, f"type: {endpoint.type_name} here, {data.type_name} there")
        if reasons:
            self._shared.emit(QosMismatch(endpoint.guid, data.guid, tuple(reasons)))
            return
        if self._is_full(endpoint, data.guid.prefix):
            self._shared.counters.over_limit += 1
            return
        participant = self._participants.of(data.guid)
        route = participant.route(data.locators)
        self._shared.emit(EndpointMatched(endpoint.guid, data.guid))
        if isinstance(endpoint, DataWriter):
            endpoint.match(data.guid, route, data.qos, now)
            return
        self._liveliness.follow(endpoint.guid, data.guid, _followed(data.qos, endpoint.qos), now)
        heartbeat = self._early.take(data.guid)
        endpoint.match(data.guid, route, data.qos, participant.data.vendor, now, heartbeat)


def _followed(offered: Qos, requested: Qos) -> Qos:
    """Return the promise of a writer to show that it is alive, as its reader takes it: within the
    lease of the reader, which is not the shorter one.
    """
    if math.inf in (offered.liveliness_lease, requested.liveliness_lease):
        return offered
    return msgspec.structs.replace(offered, liveliness_lease=requested.liveliness_lease)


class EndpointDiscovery:
    """Announces the endpoints of this participant, and takes the announcements of others."""

    def __init__(
        self,
        publications: DataWriter,
        subscriptions: DataWriter,
        remote: RemoteEndpoints,
        matcher: Matcher,
        shared: SharedParts,
    ) -> None:
        self._publications = publications
        self._subscriptions = subscriptions
        self._remote = remote
        self._matcher = matcher
        self._shared = shared

    def announce(self, data: EndpointData, now: float) -> None:
        """Announce an endpoint of this participant."""
        sample = StoredSample(payload=endpoint_payload(data), key=data.guid)
        self._writer_for(data.guid).write_sample(sample, now)

    def withdraw(self, guid: Guid, now: float) -> None:
        """Tell that an endpoint of this participant is gone."""
        status = Parameters(((pids.KEY_HASH, guid), (pids.STATUS_INFO, DISPOSED)))
        payload = list_payload(Parameters(((pids.ENDPOINT_GUID, guid),)))
        sample = StoredSample(payload=payload, inline_qos=status, key=guid, is_disposed=True)
        self._writer_for(guid).write_sample(sample, now)

    def receive(self, sample: Sample, now: float) -> None:
        """Take the announcement of an endpoint, or its end.

        Raises:
            InvalidPacket: The announcement is broken, or of an endpoint of another participant.
        """
        parameters = read_list(sample.payload) if sample.payload else Parameters(())
        guid = parameters.guid(pids.ENDPOINT_GUID) or parameters.guid(pids.KEY_HASH)
        if guid is None and sample.inline_qos is not None:
            guid = sample.inline_qos.guid(pids.KEY_HASH)
        if guid is None or guid.prefix != sample.writer.prefix:
            raise InvalidPacket("announcement of an endpoint does not name one of its sender")
        if sample.is_ended:
            self._forget(guid, now)
        elif guid.is_writer or guid.is_reader:
            self._note(read_endpoint(parameters, guid), now)

    def forget_participant(self, prefix: bytes, now: float) -> None:
        """Forget the endpoints of a participant."""
        for guid in self._remote.of_participant(prefix):
            self._forget(guid, now)

    def _note(self, data: EndpointData, now: float) -> None:
        known = self._remote.get(data.guid)
        if known == data:
            return
        if known is not None:
            self._forget(data.guid, now)
        if self._remote.add(data):
            self._matcher.match_remote(data, now)
        else:
            self._shared.counters.over_limit += 1

    def _forget(self, guid: Guid, now: float) -> None:
        if self._remote.remove(guid) is not None:
            self._matcher.unmatch_remote(guid, now)

    def _writer_for(self, guid: Guid) -> DataWriter:
        return self._publications if guid.is_writer else self._subscriptions

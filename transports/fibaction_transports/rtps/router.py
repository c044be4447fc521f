"""The way of received submessages to the endpoints that they are for."""

from __future__ import annotations

from fibaction_transports.rtps.discovery.known_participants import KnownParticipants
from fibaction_transports.rtps.discovery.liveliness import WriterLiveliness
from fibaction_transports.rtps.discovery.local_endpoints import LocalEndpoints
from fibaction_transports.rtps.endpoints.early_heartbeats import EarlyHeartbeats
from fibaction_transports.rtps.endpoints.sample import received_sample
from fibaction_transports.rtps.endpoints.shared import SharedParts
from fibaction_transports.rtps.messages.ids import (
    SPDP_WRITER,
    UNKNOWN_PREFIX,
    Guid,
    is_builtin,
)
from fibaction_transports.rtps.messages.locators import Address
from fibaction_transports.rtps.messages.submessages import (
    AckNack,
    Data,
    DataFragment,
    Destination,
    FragmentNack,
    Gap,
    Packet,
    SourceInfo,
    Submessage,
    Timestamp,
    WriterHeartbeat,
)

DISCOVERY_AT_ONCE = 64
"""Samples of discovery that are taken of one datagram: each may cost much. Those that are left out
are requested again.
"""


class MessageRouter:
    """Takes packets, and gives each submessage to the endpoints that it is for.

    INFO_REPLY is not used: answers go to the addresses that discovery has told. HEARTBEAT_FRAG is
    not used either: fragments are requested after a pause, whether it has told of them or not.
    """

    def __init__(
        self,
        endpoints: LocalEndpoints,
        participants: KnownParticipants,
        early: EarlyHeartbeats,
        liveliness: WriterLiveliness,
        shared: SharedParts,
    ) -> None:
        self._own = shared.prefix
        self._endpoints = endpoints
        self._participants = participants
        self._early = early
        self._liveliness = liveliness
        self._counters = shared.counters

    def route(self, packet: Packet, source: Address, now: float) -> None:
        """Hand over the submessages of a packet from this address.

        Raises:
            InvalidPacket: An announcement of discovery is broken; what came before it is taken.
        """
        prefix, vendor, size = packet.prefix, packet.vendor, packet.size
        self._counters.own += prefix == self._own
        sender = self._participants.sender(prefix, source[0], size, now)
        time: float | None = None
        is_ours, of_discovery = True, 0
        for submessage in packet.submessages:
            if isinstance(submessage, Destination):
                is_ours = submessage.prefix in (self._own, UNKNOWN_PREFIX)
                if sender is not None and submessage.prefix == self._own:
                    self._participants.prove(sender, source[0])
                continue
            if isinstance(submessage, SourceInfo):
                prefix, vendor, size = submessage.prefix, submessage.vendor, 0
                sender = self._participants.sender(prefix, source[0], size, now)
                continue
            if isinstance(submessage, Timestamp):
                time = submessage.time
                continue
            if not is_ours or prefix == self._own:
                continue
            if sender is not None and not sender.is_at(source[0]):
                self._counters.forged += 1
                continue
            if isinstance(submessage, Data) and is_builtin(submessage.writer):
                of_discovery += 1
                if of_discovery > DISCOVERY_AT_ONCE:
                    self._counters.over_limit += 1
                    continue
                if submessage.writer == SPDP_WRITER:
                    sample = received_sample(Guid(prefix + SPDP_WRITER), submessage, time)
                    self._participants.receive(sample, vendor, source[0], size, now)
                    sender = self._participants.get(prefix)
                    continue
            if sender is not None:  # nothing of a stranger is matched
                self._hand_over(prefix, submessage, time, now)

    def _hand_over(
        self, prefix: bytes, submessage: Submessage, time: float | None, now: float
    ) -> None:
        if isinstance(submessage, Data | DataFragment):
            guid = Guid(prefix + submessage.writer)
            self._sample(submessage.reader, guid, submessage, time, now)
        elif isinstance(submessage, WriterHeartbeat):
            guid = Guid(prefix + submessage.writer)
            self._heartbeat(submessage.reader, guid, submessage, now)
        elif isinstance(submessage, AckNack | FragmentNack):
            self._nack(Guid(prefix + submessage.reader), submessage.writer, submessage, now)
        elif isinstance(submessage, Gap):
            guid = Guid(prefix + submessage.writer)
            for matched in self._endpoints.addressed(submessage.reader, guid):
                matched.receive_gap(guid, submessage, now)

    def _nack(self, reader: Guid, entity: bytes, nack: AckNack | FragmentNack, now: float) -> None:
        writer = self._endpoints.writers.get(entity)
        if writer is None:
            return
        if isinstance(nack, FragmentNack):
            writer.receive_fragment_nack(reader, nack, now)
            return
        participant = self._participants.get(reader.prefix)
        if participant is not None and is_builtin(entity):
            participant.has_acknowledged = True
        writer.receive_acknack(reader, nack, now)

    def _sample(
        self, reader: bytes, writer: Guid, data: Data | DataFragment, time: float | None, now: float
    ) -> None:
        is_known = False
        for found in self._endpoints.addressed(reader, writer):
            if isinstance(data, Data):
                is_known |= found.receive_data(writer, data, time, now)
            else:
                is_known |= found.receive_fragment(writer, data, time, now)
        if not is_known:
            self._early.note_sample(writer, data.number)
        if not is_builtin(writer.entity):
            self._liveliness.hear(writer, now)

    def _heartbeat(
        self, reader: bytes, writer: Guid, heartbeat: WriterHeartbeat, now: float
    ) -> None:
        is_known = False
        for found in self._endpoints.addressed(reader, writer):
            is_known |= found.receive_heartbeat(writer, heartbeat, now)
        if not is_known:
            self._early.keep(writer, heartbeat)
        if heartbeat.is_alive:
            self._liveliness.hear(writer, now)

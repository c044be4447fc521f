"""The way of received submessages to the endpoints that they are for."""

from __future__ import annotations

from fibaction_transports.rtps.discovery.known_participants import (
    KnownParticipants,
    RemoteParticipant,
)
from fibaction_transports.rtps.discovery.liveliness import WriterLiveliness
from fibaction_transports.rtps.discovery.local_endpoints import LocalEndpoints
from fibaction_transports.rtps.endpoints.reader import EarlyHeartbeats
from fibaction_transports.rtps.endpoints.sample import received_sample
from fibaction_transports.rtps.endpoints.shared import SharedParts
from fibaction_transports.rtps.messages.ids import (
    BUILTIN,
    SPDP_WRITER,
    UNKNOWN_PREFIX,
    Address,
    Guid,
    is_builtin,
)
from fibaction_transports.rtps.messages.submessages import (
    AckNack,
    Data,
    DataFragment,
    Destination,
    FragmentNack,
    Packet,
    SourceInfo,
    Timestamp,
    WriterHeartbeat,
)

_SAMPLES, _NACKS = (Data, DataFragment), (AckNack, FragmentNack)  # unions are slow to check
DISCOVERY_AT_ONCE = 64
"""Samples of discovery that are taken of one datagram: each may cost much. Those that are left out
are requested again.
"""


class MessageRouter:
    """Takes packets, and gives each submessage to the endpoints that it is for."""

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
        host, prefix, vendor, size = source[0], packet.prefix, packet.vendor, packet.size
        self._counters.own += prefix == self._own
        sender, is_forged = self._participants.sender(prefix, host, size, now)
        time: float | None = None
        is_ours, of_discovery = True, 0
        for submessage in packet.submessages:
            if isinstance(submessage, Destination):
                is_ours = submessage.prefix in (self._own, UNKNOWN_PREFIX)
                if sender is not None and submessage.prefix == self._own:
                    self._participants.prove(sender, host)
            elif isinstance(submessage, SourceInfo):
                prefix, vendor, size = submessage.prefix, submessage.vendor, 0
                sender, is_forged = self._participants.sender(prefix, host, size, now)
            elif isinstance(submessage, Timestamp):
                time = submessage.time
            elif not is_ours or prefix == self._own:
                continue
            elif is_forged:
                self._counters.forged += 1
            elif isinstance(submessage, Data) and submessage.writer[3] & BUILTIN == BUILTIN:
                of_discovery += 1
                if of_discovery > DISCOVERY_AT_ONCE:
                    self._counters.over_limit += 1
                elif submessage.writer == SPDP_WRITER:
                    sample = received_sample(Guid(prefix + SPDP_WRITER), submessage, time)
                    self._participants.receive(sample, vendor, host, size, now)
                    sender = self._participants.get(prefix)
                elif sender is not None:
                    self._sample(prefix, submessage, time, now)
            elif sender is None:
                continue  # nothing of a stranger is matched
            elif isinstance(submessage, _SAMPLES):
                self._sample(prefix, submessage, time, now)
            elif isinstance(submessage, WriterHeartbeat):
                self._heartbeat(prefix, submessage, now)
            elif isinstance(submessage, _NACKS):
                self._nack(sender, submessage, now)
            else:  # a GAP
                writer = Guid(prefix + submessage.writer)
                for matched in self._endpoints.matched(submessage.reader, writer):
                    matched.receive_gap(submessage, now)

    def _nack(self, sender: RemoteParticipant, nack: AckNack | FragmentNack, now: float) -> None:
        writer = self._endpoints.writers.get(nack.writer)
        if writer is None:
            return
        reader = Guid(sender.data.prefix + nack.reader)
        if isinstance(nack, FragmentNack):
            writer.receive_fragment_nack(reader, nack, now)
            return
        if is_builtin(nack.writer):
            sender.has_acknowledged = True
        writer.receive_acknack(reader, nack, now)

    def _sample(
        self, prefix: bytes, data: Data | DataFragment, time: float | None, now: float
    ) -> None:
        writer = Guid(prefix + data.writer)
        matched = self._endpoints.matched(data.reader, writer)
        for found in matched:
            if isinstance(data, Data):
                found.receive_data(data, time, now)
            else:
                found.receive_fragment(data, time, now)
        if not matched:
            self._early.note_sample(writer, data.number)
        if data.writer[3] & BUILTIN != BUILTIN:
            self._liveliness.hear(prefix, writer, now)

    def _heartbeat(self, prefix: bytes, heartbeat: WriterHeartbeat, now: float) -> None:
        writer = Guid(prefix + heartbeat.writer)
        matched = self._endpoints.matched(heartbeat.reader, writer)
        for found in matched:
            found.receive_heartbeat(heartbeat, now)
        if not matched:
            self._early.keep(writer, heartbeat)
        if heartbeat.is_alive:
            self._liveliness.hear(prefix, writer, now)

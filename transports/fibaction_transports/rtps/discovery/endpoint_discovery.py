"""The announcements of endpoints, own and others' (SEDP)."""

from __future__ import annotations

from fibaction_transports.rtps.discovery.matcher import Matcher
from fibaction_transports.rtps.discovery.remote_endpoints import (
    EndpointData,
    RemoteEndpoints,
    endpoint_payload,
    read_endpoint,
)
from fibaction_transports.rtps.endpoints.history import StoredSample
from fibaction_transports.rtps.endpoints.sample import DISPOSED, Sample
from fibaction_transports.rtps.endpoints.shared import SharedParts
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.messages import parameters as pids
from fibaction_transports.rtps.messages.ids import Guid
from fibaction_transports.rtps.messages.layout import InvalidPacket
from fibaction_transports.rtps.messages.parameters import Parameters, list_payload, read_list


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

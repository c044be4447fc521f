"""The other participants: how they are found, how long they are believed to be there (SPDP)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

from fibaction_transports.rtps.discovery.participant_data import (
    ParticipantData,
    participant_payload,
    read_participant,
)
from fibaction_transports.rtps.discovery.payloads import list_payload, read_list
from fibaction_transports.rtps.endpoints.sample import DISPOSED, Sample
from fibaction_transports.rtps.endpoints.shared import SharedParts
from fibaction_transports.rtps.events import ParticipantFound, ParticipantLost
from fibaction_transports.rtps.messages import parameters as pids
from fibaction_transports.rtps.messages.errors import InvalidPacket
from fibaction_transports.rtps.messages.ids import (
    PARTICIPANT,
    SPDP_WRITER,
    UNKNOWN_ENTITY,
    Guid,
)
from fibaction_transports.rtps.messages.locators import Address, Locator
from fibaction_transports.rtps.messages.parameters import Parameters
from fibaction_transports.rtps.messages.submessages import Data
from fibaction_transports.rtps.outbox import PeerRoute

FIRST_ANNOUNCEMENTS = 10
FIRST_PAUSE = 0.1
"""Seconds between the first announcements, of which some may be lost."""
PAUSE = 3.0
"""Seconds between the later ones."""
REPLY_PAUSE = 0.05
"""Seconds within which a participant is answered once."""
SHORTEST_LEASE, LONGEST_LEASE = 1.0, 300.0
"""The leases that are believed, in seconds: so silent participants do not fill the table."""
_LOOPBACK = "127."
_LOCALHOST = "127.0.0.1"


def reachable(locators: Iterable[Locator], source: str) -> Address | None:
    """Choose the address to send to, for a participant that sends from this host.

    A participant of this machine announces the addresses of its interfaces, and is reached over
    the loopback interface all the same. Of several interfaces, the one that it sends from is used.
    """
    addresses = [found for locator in locators if (found := locator.udp_address) is not None]
    if not addresses:
        return None
    if source.startswith(_LOOPBACK):
        return _LOCALHOST, addresses[0][1]
    return next((address for address in addresses if address[0] == source), addresses[0])


class RemoteParticipant:
    """Another participant, as it has announced itself."""

    def __init__(self, data: ParticipantData, source: str, discovery: Address) -> None:
        self.data = data
        self.discovery = PeerRoute(discovery, data.prefix)
        """The way for discovery."""
        self._source = source
        self._default = reachable(data.data_locators, source) or discovery
        self.expires = math.inf
        """The time at which it is gone, if it does not announce itself before."""
        self.answered = -math.inf
        """The time at which it was last sent an announcement of its own."""
        self.has_acknowledged = False
        """True if it knows this participant: it has acknowledged something of discovery."""

    def route(self, locators: Sequence[Locator]) -> PeerRoute:
        """Return the way to an endpoint of it, which may have addresses of its own."""
        address = reachable(locators, self._source) or self._default
        return PeerRoute(address, self.data.prefix)


class KnownParticipants:
    """The table of the other participants, and the announcements of this one."""

    def __init__(
        self,
        own: ParticipantData,
        announce_to: Sequence[Address],
        shared: SharedParts,
        *,
        on_found: Callable[[RemoteParticipant, float], None],
        on_lost: Callable[[bytes, float], None],
    ) -> None:
        self._own = own
        self._announce_to = announce_to
        self._shared = shared
        self._on_found = on_found
        self._on_lost = on_lost
        self._found: dict[bytes, RemoteParticipant] = {}
        self._announced = 0

    def get(self, prefix: bytes) -> RemoteParticipant | None:
        """Return a participant; None if it is not known."""
        return self._found.get(prefix)

    def of(self, endpoint: Guid) -> RemoteParticipant:
        """Return the participant of an endpoint that it has announced."""
        return self._found[endpoint.prefix]

    def on_announcement_due(self, now: float) -> None:
        """Announce this participant."""
        self._announced += 1
        for address in self._announce_to:
            self._announce(PeerRoute(address))
        for remote in self._found.values():
            self._announce(remote.discovery)
        pause = FIRST_PAUSE if self._announced < FIRST_ANNOUNCEMENTS else PAUSE
        self._shared.timers.set(self.on_announcement_due, now + min(pause, self._own.lease / 4))

    def receive(self, sample: Sample, vendor: bytes, source: Address, now: float) -> None:
        """Take the announcement of a participant, or its leave.

        Raises:
            InvalidPacket: The announcement is broken, or about another participant.
        """
        prefix = sample.writer.prefix
        if sample.is_ended:
            self._lose(prefix, now, has_left=True)
            return
        data = read_participant(read_list(sample.payload), vendor)
        if data.prefix != prefix:
            raise InvalidPacket("announcement is about another participant than its sender")
        if data.domain not in (None, self._own.domain) or data.domain_tag:
            return
        remote = self._found.get(prefix) or self._add(data, source[0], now)
        if remote is None:
            return
        remote.expires = now + min(max(data.lease, SHORTEST_LEASE), LONGEST_LEASE)
        self._shared.timers.set_earlier(self.on_leases_due, remote.expires)
        if not remote.has_acknowledged and now - remote.answered >= REPLY_PAUSE:
            remote.answered = now
            self._announce(remote.discovery)

    def on_leases_due(self, now: float) -> None:
        """Forget the participants that have been silent for their leases."""
        for prefix in [p for p, remote in self._found.items() if remote.expires <= now]:
            self._lose(prefix, now, has_left=False)
        if self._found:
            earliest = min(remote.expires for remote in self._found.values())
            self._shared.timers.set(self.on_leases_due, earliest)

    def leave(self) -> None:
        """Tell all that this participant leaves."""
        guid = self._own.prefix + PARTICIPANT
        status = Parameters(((pids.KEY_HASH, guid), (pids.STATUS_INFO, DISPOSED)))
        payload = list_payload(Parameters(((pids.PARTICIPANT_GUID, guid),)))
        data = Data(UNKNOWN_ENTITY, SPDP_WRITER, 2, payload, status, is_key=True)
        routes = [PeerRoute(address) for address in self._announce_to]
        for route in [*routes, *(remote.discovery for remote in self._found.values())]:
            self._shared.outbox.add(route, data)

    def _announce(self, route: PeerRoute) -> None:
        data = Data(UNKNOWN_ENTITY, SPDP_WRITER, 1, participant_payload(self._own))
        self._shared.outbox.add(route, data)

    def _add(self, data: ParticipantData, source: str, now: float) -> RemoteParticipant | None:
        """Note a new participant; return None if it cannot be reached, or there are too many."""
        address = reachable(data.discovery_locators, source)
        if address is None or len(self._found) >= self._shared.limits.participants:
            self._shared.counters.over_limit += 1
            return None
        remote = self._found[data.prefix] = RemoteParticipant(data, source, address)
        event = ParticipantFound(data.prefix, data.vendor, data.name, data.user_data)
        self._shared.emit(event)
        self._on_found(remote, now)
        return remote

    def _lose(self, prefix: bytes, now: float, *, has_left: bool) -> None:
        if self._found.pop(prefix, None) is not None:
            self._on_lost(prefix, now)
            self._shared.emit(ParticipantLost(prefix, has_left))

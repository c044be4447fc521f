"""The other participants: how they are found, how long they are believed to be there (SPDP)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

from fibaction_transports.rtps.discovery.remote_participant import (
    ParticipantData,
    RemoteParticipant,
    participant_payload,
    reachable,
    read_participant,
)
from fibaction_transports.rtps.endpoints.sample import DISPOSED, Sample
from fibaction_transports.rtps.endpoints.shared import SharedParts
from fibaction_transports.rtps.events import ParticipantFound, ParticipantLost
from fibaction_transports.rtps.limits import HostRates
from fibaction_transports.rtps.messages import parameters as pids
from fibaction_transports.rtps.messages.ids import (
    PARTICIPANT,
    SPDP_WRITER,
    UNKNOWN_ENTITY,
    Guid,
)
from fibaction_transports.rtps.messages.layout import InvalidPacket
from fibaction_transports.rtps.messages.locators import Address
from fibaction_transports.rtps.messages.parameters import Parameters, list_payload, read_list
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
SHORTEST_ANNOUNCEMENT = 0.01
"""Seconds within which one announcement of a participant is read."""
NEWCOMERS_AT_ONCE, NEWCOMERS_PER_SECOND = 128, 64.0
"""The new participants of one host that are taken."""


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
        self.vendors: dict[bytes, bytes] = {}
        """The vendor of each known participant."""
        self._unproven: dict[bytes, RemoteParticipant] = {}
        self._hosts: Counter[str] = Counter()
        limits = shared.limits
        self._newcomers = HostRates(NEWCOMERS_AT_ONCE, NEWCOMERS_PER_SECOND, limits.hosts)
        self._payload = participant_payload(own)
        self._announced = 0

    def get(self, prefix: bytes) -> RemoteParticipant | None:
        """Return a participant; None if it is not known."""
        return self._found.get(prefix)

    def all(self) -> list[RemoteParticipant]:
        """Return the participants that are known."""
        return list(self._found.values())

    def of(self, endpoint: Guid) -> RemoteParticipant:
        """Return the participant of an endpoint that it has announced."""
        return self._found[endpoint.prefix]

    def sender(
        self, prefix: bytes, host: str, size: int, now: float
    ) -> tuple[RemoteParticipant | None, bool]:
        """Return a known participant in whose name a datagram of this size came from a host, and
        whether it is at another host.

        It renews the lease: Cyclone DDS announces itself once in most of a lease, so one lost
        announcement would end a participant that sends all the time.
        """
        remote = self._found.get(prefix)
        if remote is None:
            return None, False
        if not remote.is_at(host):
            return remote, True
        remote.expires = now + remote.lease
        if not remote.budget.is_proven:
            remote.budget.earn(size)
        return remote, False

    def prove(self, remote: RemoteParticipant, host: str) -> None:
        """Note that something for this very participant came from a host in the name of another."""
        if not remote.budget.is_proven and remote.is_sent_to(host):
            remote.budget.is_proven = True
            self._unproven.pop(remote.data.prefix, None)

    def on_announcement_due(self, now: float) -> None:
        """Announce this participant."""
        self._announced += 1
        for address in self._announce_to:
            self._announce(PeerRoute(address))
        for remote in self._found.values():
            if remote.discovery.address not in self._announce_to:
                self._announce(remote.discovery)
        pause = FIRST_PAUSE if self._announced < FIRST_ANNOUNCEMENTS else PAUSE
        self._shared.timers.set(self.on_announcement_due, now + min(pause, self._own.lease / 4))

    def receive(self, sample: Sample, vendor: bytes, host: str, size: int, now: float) -> None:
        """Take the announcement of a participant, or its leave, in a datagram of that size.

        Raises:
            InvalidPacket: The announcement is broken, or about another participant.
        """
        prefix = sample.writer.prefix
        remote = self._found.get(prefix)
        if sample.is_ended:
            self._lose(prefix, now, has_left=True)
            return
        if remote is None and not self._newcomers.take(host, now):
            self._shared.counters.over_limit += 1
            return
        if remote is not None and 0 < now - remote.heard < SHORTEST_ANNOUNCEMENT:
            return
        data = read_participant(read_list(sample.payload), vendor)
        if data.prefix != prefix:
            raise InvalidPacket("announcement is about another participant than its sender")
        if data.domain not in (None, self._own.domain) or data.domain_tag:
            self._shared.counters.of_other_domains += 1
            return
        remote = remote or self._add(data, host, max(size, len(sample.payload)), now)
        if remote is None:
            return
        remote.heard = now
        remote.lease = min(max(data.lease, SHORTEST_LEASE), LONGEST_LEASE)
        remote.expires = now + remote.lease
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
        data = Data(UNKNOWN_ENTITY, SPDP_WRITER, 1, self._payload)
        self._shared.outbox.add(route, data)

    def _add(
        self, data: ParticipantData, source: str, size: int, now: float
    ) -> RemoteParticipant | None:
        """Note a new participant; return None if it cannot be reached, or there are too many."""
        address = reachable(data.discovery_locators, source)
        if address is None or not self._has_room(source, now):
            self._shared.counters.over_limit += 1
            return None
        remote = RemoteParticipant(data, source, address, now)
        remote.budget.earn(size)
        self._found[data.prefix] = self._unproven[data.prefix] = remote
        self._shared.budgets[data.prefix] = remote.budget
        self.vendors[data.prefix] = data.vendor
        self._hosts[source] += 1
        event = ParticipantFound(data.prefix, data.vendor, data.name, data.user_data)
        self._shared.emit(event)
        self._on_found(remote, now)
        return remote

    def _has_room(self, source: str, now: float) -> bool:
        """Return whether there is room for another participant of a host.

        Participants that have not shown yet that they receive anything make room for it.
        """
        limits = self._shared.limits
        unproven = iter(self._unproven.values())
        if self._hosts[source] >= limits.participants_of_host:
            given_up = next((each for each in unproven if each.source == source), None)
        elif len(self._found) >= limits.participants:
            given_up = next(unproven, None)
        else:
            return True
        if given_up is None:
            return False
        self._shared.counters.over_limit += 1
        self._lose(given_up.data.prefix, now, has_left=False)
        return True

    def _lose(self, prefix: bytes, now: float, *, has_left: bool) -> None:
        remote = self._found.pop(prefix, None)
        if remote is None:
            return
        self._unproven.pop(prefix, None)
        self._shared.budgets.pop(prefix)
        del self.vendors[prefix]
        self._hosts[remote.source] -= 1
        if not self._hosts[remote.source]:
            del self._hosts[remote.source]
        self._on_lost(prefix, now)
        self._shared.emit(ParticipantLost(prefix, has_left))

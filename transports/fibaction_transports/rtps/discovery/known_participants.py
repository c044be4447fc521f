"""The other participants: their announcements (SPDP), the ways to them, and their leases."""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Sequence

from msgspec import Struct

from fibaction_transports.rtps.endpoints.sample import DISPOSED, Sample
from fibaction_transports.rtps.endpoints.shared import SharedParts
from fibaction_transports.rtps.events import ParticipantFound, ParticipantLost
from fibaction_transports.rtps.limits import HostRates, PeerBudget
from fibaction_transports.rtps.messages import parameters as pids
from fibaction_transports.rtps.messages.ids import (
    OWN_VENDOR,
    PARTICIPANT,
    SPDP_WRITER,
    UNKNOWN_ENTITY,
    Address,
    Guid,
    Locator,
    is_ipv6,
    without_scope,
)
from fibaction_transports.rtps.messages.layout import VERSION, InvalidPacket, duration_bytes
from fibaction_transports.rtps.messages.parameters import Parameters, list_payload, read_list
from fibaction_transports.rtps.messages.submessages import Data
from fibaction_transports.rtps.outbox import PeerRoute

DEFAULT_LEASE = 100.0
"""The lease of a participant that does not tell its own, in seconds."""

PUBLICATIONS_ANNOUNCER = 1 << 2
PUBLICATIONS_DETECTOR = 1 << 3
SUBSCRIPTIONS_ANNOUNCER = 1 << 4
SUBSCRIPTIONS_DETECTOR = 1 << 5
LIVELINESS_ANNOUNCER = 1 << 10
LIVELINESS_DETECTOR = 1 << 11
ASKS_ABOUT_TYPES = 1 << 12 | 1 << 15
"""A writer of questions about types, and a reader of the answers."""
ANSWERS_TYPES = 1 << 13 | 1 << 14
OWN_ENDPOINTS = 0xC3F | ASKS_ABOUT_TYPES
"""The endpoints of discovery that this implementation has."""


class ParticipantData(Struct, frozen=True, kw_only=True):
    """A participant, as it announces itself."""

    prefix: bytes
    vendor: bytes = OWN_VENDOR
    name: str = ""
    user_data: bytes = b""
    lease: float = DEFAULT_LEASE
    """Seconds after which it is gone, if it has not announced itself again."""
    endpoints: int = OWN_ENDPOINTS
    """The endpoints of discovery that it has, a bit for each."""
    domain: int | None = None
    """The domain that it is in; None if it does not tell."""
    domain_tag: str = ""
    discovery_locators: tuple[Locator, ...] = ()
    data_locators: tuple[Locator, ...] = ()


def participant_payload(data: ParticipantData) -> bytes:
    """Return the announcement of a participant."""
    items = [
        (pids.PROTOCOL_VERSION, VERSION),
        (pids.VENDOR_ID, data.vendor),
        (pids.PARTICIPANT_GUID, data.prefix + PARTICIPANT),
        *pids.locator_items(pids.METATRAFFIC_UNICAST_LOCATOR, data.discovery_locators),
        *pids.locator_items(pids.DEFAULT_UNICAST_LOCATOR, data.data_locators),
        (pids.LEASE, duration_bytes(data.lease)),
        (pids.BUILTIN_ENDPOINTS, struct.pack("<I", data.endpoints)),
        (pids.ENTITY_NAME, pids.text_value(data.name)),
        (pids.USER_DATA, pids.blob_value(data.user_data)),
    ]
    if data.domain is not None:
        items.append((pids.DOMAIN_ID, struct.pack("<I", data.domain)))
    return list_payload(Parameters(tuple(items)))


def read_participant(parameters: Parameters, vendor: bytes) -> ParticipantData:
    """Read the announcement of a participant.

    Raises:
        InvalidPacket: It does not tell which participant it is, or a parameter is broken.
    """
    guid = parameters.guid(pids.PARTICIPANT_GUID)
    if guid is None:
        raise InvalidPacket("announcement does not name its participant")
    domain = parameters.octets(pids.DOMAIN_ID, 4)
    return ParticipantData(
        prefix=guid.prefix,
        vendor=vendor,
        name=parameters.text(pids.ENTITY_NAME) or "",
        user_data=parameters.blob(pids.USER_DATA) or b"",
        lease=parameters.duration(pids.LEASE, DEFAULT_LEASE),
        endpoints=parameters.u32(pids.BUILTIN_ENDPOINTS, 0),
        domain=None if domain is None else parameters.u32(pids.DOMAIN_ID, 0),
        domain_tag=parameters.text(pids.DOMAIN_TAG) or "",
        discovery_locators=tuple(parameters.locators(pids.METATRAFFIC_UNICAST_LOCATOR)),
        data_locators=tuple(parameters.locators(pids.DEFAULT_UNICAST_LOCATOR)),
    )


_LOOPBACK = "127."
_LOCALHOST, _LOCALHOST_IPV6 = "127.0.0.1", "::1"
_LINK_LOCAL = "fe80:"


def reachable(locators: Iterable[Locator], source: str) -> Address | None:
    """Choose the address to send to, for a participant that sends from this host.

    A participant of this machine announces the addresses of its interfaces, and is reached over
    the loopback interface all the same. If it has several interfaces, the one that it sends from is
    used, with the version of IP by which it was heard. A link-local address does not tell its
    interface, so it is used only if it is sent from.
    """
    addresses = [each for each in _addresses(locators) if is_ipv6(each[0]) == is_ipv6(source)]
    if addresses and _is_loopback(source):
        return _LOCALHOST_IPV6 if is_ipv6(source) else _LOCALHOST, addresses[0][1]
    for host, port in addresses:
        if host == without_scope(source):
            return source, port
    return next((each for each in addresses if not each[0].startswith(_LINK_LOCAL)), None)


def _is_loopback(host: str) -> bool:
    return host.startswith(_LOOPBACK) or host == _LOCALHOST_IPV6


def _addresses(locators: Iterable[Locator]) -> list[Address]:
    return [found for locator in locators if (found := locator.udp_address) is not None]


class RemoteParticipant:
    """Another participant, as it has announced itself.

    Its locators are believed as far as they name the host from which it sends: nobody is to be
    flooded because a peer says so.
    """

    def __init__(self, data: ParticipantData, source: str, discovery: Address, now: float) -> None:
        self.data = data
        self.source = source
        """The host from which it has announced itself."""
        self.discovery = PeerRoute(discovery, data.prefix)
        """The way for discovery."""
        self.budget = PeerBudget(now)
        """Its budget: the bytes that it may be sent."""
        locators = (*data.discovery_locators, *data.data_locators)
        hosts = (host for host, _ in _addresses(locators))
        self._hosts = {source, *(host for host in hosts if not host.startswith(_LINK_LOCAL))}
        self._is_at_source = discovery[0] in (source, _LOCALHOST, _LOCALHOST_IPV6)
        self._default = self._address(data.data_locators) or discovery
        self.lease = math.inf
        """Seconds of silence after which it is gone."""
        self.expires = math.inf
        """The time at which it is gone, if nothing of it arrives before."""
        self.found = self.heard = now
        """The time of its last announcement; `found` is that of the first one."""
        self.answered = -math.inf
        """The time at which it was last sent an announcement of its own."""
        self.has_acknowledged = False
        """True if it knows this participant: it has acknowledged something of discovery."""

    def is_at(self, host: str) -> bool:
        """Return whether it may send from this host. No other machine can send from a loopback
        address.
        """
        return host in self._hosts or _is_loopback(host)

    def is_sent_to(self, host: str) -> bool:
        """Return whether it is at a host from which it has announced itself, and is sent to that
        host.
        """
        return self._is_at_source and self.is_at(host)

    def route(self, locators: Sequence[Locator]) -> PeerRoute:
        """Return the way to an endpoint of it, which may have addresses of its own."""
        return PeerRoute(self._address(locators) or self._default, self.data.prefix)

    def _address(self, locators: Iterable[Locator]) -> Address | None:
        """Return the address among locators at which it may be sent to; None if there is none."""
        host = self.discovery.address[0]
        address = reachable(locators, self.source)
        return address if address is not None and address[0] == host else None


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

"""Another participant: its announcement (SPDP), and the way to it."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence

from msgspec import Struct

from fibaction_transports.rtps.limits import PeerBudget
from fibaction_transports.rtps.messages import parameters as pids
from fibaction_transports.rtps.messages.ids import OWN_VENDOR, PARTICIPANT
from fibaction_transports.rtps.messages.layout import VERSION, InvalidPacket, duration_bytes
from fibaction_transports.rtps.messages.locators import (
    Address,
    Locator,
    is_ipv6,
    without_scope,
)
from fibaction_transports.rtps.messages.parameters import Parameters, list_payload
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

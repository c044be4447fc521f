"""The ports of a domain, and the settings that ROS reads from the environment."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Final

from msgspec import Struct

from fibaction_transports.rtps.messages.locators import Address, is_ipv6

GROUP = "239.255.0.1"
"""The multicast group of discovery over IPv4."""
GROUPS: Final = {4: (GROUP,), 6: ("ff1e::ffff:efff:1", "ff02::ffff:efff:1")}
"""The groups of discovery for each version of IP; over IPv6, those of Fast DDS and Cyclone DDS."""
LOCALHOST = "127.0.0.1"
LOCALHOSTS: Final = {4: LOCALHOST, 6: "::1"}

DOMAINS = range(233)
"""The domains whose ports are below 65,536."""
PARTICIPANTS = range(120)
"""The participants of one host whose ports are below those of the next domain."""
LOCAL_PARTICIPANTS = range(32)
"""The participants of this host that are announced to, without multicast."""
PEER_PARTICIPANTS = range(4)
"""The participants of a static peer that are announced to."""

IP_VERSIONS: Final = ((4,), (6,), (4, 6))
"""The versions of IP that a participant may use."""
_FIRST_PORT, _PER_DOMAIN, _PER_PARTICIPANT = 7400, 250, 2
_DISCOVERY, _DATA = 10, 11


class DiscoveryRange(Enum):
    """The range in which a participant looks for others, by ROS_AUTOMATIC_DISCOVERY_RANGE."""

    OFF = "OFF"
    LOCALHOST = "LOCALHOST"
    SUBNET = "SUBNET"


class DomainSettings(Struct, frozen=True, kw_only=True):
    """The domain of a participant, and how far it looks for others."""

    domain: int = 0
    discovery_range: DiscoveryRange = DiscoveryRange.LOCALHOST
    static_peers: tuple[str, ...] = ()
    """Hosts that are asked in addition, unless the range is OFF."""
    ip_versions: tuple[int, ...] = (4,)
    """The versions of IP that are used: 4, 6, or both."""

    def __post_init__(self) -> None:
        if self.domain not in DOMAINS:
            raise ValueError(f"domain {self.domain} is not between 0 and {DOMAINS[-1]}")
        if self.ip_versions not in IP_VERSIONS:
            raise ValueError(f"versions {self.ip_versions} of IP are not 4, 6, or both")

    @classmethod
    def from_environment(
        cls, environ: Mapping[str, str], ip_versions: tuple[int, ...] = ()
    ) -> DomainSettings:
        """Read the settings as ROS does: SUBNET if nothing is said.

        Without versions of IP, it is IPv4, and IPv6 as well if a static peer is an address of it.

        Raises:
            ValueError: A variable has a value that ROS does not know.
        """
        text = environ.get("ROS_DOMAIN_ID") or "0"
        if not text.isdecimal():
            raise ValueError(f"ROS_DOMAIN_ID={text!r} is not a number: set it to one from 0 to 232")
        word = environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or "SUBNET"
        if environ.get("ROS_LOCALHOST_ONLY") == "1":
            word = "LOCALHOST"
        if word == "SYSTEM_DEFAULT":
            word = "SUBNET"
        if word not in DiscoveryRange.__members__:
            raise ValueError(
                f"ROS_AUTOMATIC_DISCOVERY_RANGE={word!r} is not one of SUBNET, LOCALHOST, OFF"
            )
        texts = (text.strip() for text in environ.get("ROS_STATIC_PEERS", "").split(";"))
        peers = tuple(filter(None, texts))
        usual = (4, 6) if any(map(is_ipv6, peers)) else (4,)
        return cls(
            domain=int(text),
            discovery_range=DiscoveryRange[word],
            static_peers=peers,
            ip_versions=ip_versions or usual,
        )


def multicast_port(domain: int) -> int:
    """Return the port of discovery by multicast."""
    return _FIRST_PORT + _PER_DOMAIN * domain


def discovery_port(domain: int, participant: int) -> int:
    """Return the port at which a participant receives discovery."""
    return multicast_port(domain) + _DISCOVERY + _PER_PARTICIPANT * participant


def data_port(domain: int, participant: int) -> int:
    """Return the port at which a participant receives samples."""
    return multicast_port(domain) + _DATA + _PER_PARTICIPANT * participant


def announced_addresses(
    settings: DomainSettings, peers: tuple[str, ...], number: int = 0
) -> tuple[Address, ...]:
    """Return the addresses to which a participant with this number announces itself; `peers` are
    addresses of the static peers.

    On this host it announces itself to all with smaller numbers at least, so that of any two, one
    finds the other.
    """
    domain, reach = settings.domain, settings.discovery_range
    if reach is DiscoveryRange.OFF:
        return ()
    found = [
        (peer, discovery_port(domain, number)) for peer in peers for number in PEER_PARTICIPANTS
    ]
    versions = settings.ip_versions
    if reach is DiscoveryRange.SUBNET:
        port = multicast_port(domain)
        return (*((group, port) for version in versions for group in GROUPS[version]), *found)
    ports = [discovery_port(domain, n) for n in range(max(number, LOCAL_PARTICIPANTS.stop))]
    local = [(LOCALHOSTS[version], port) for version in versions for port in ports]
    return (*local, *found)

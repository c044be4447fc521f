"""The ports of a domain, and the settings that ROS reads from the environment."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum

from msgspec import Struct

from fibaction_transports.rtps.messages.locators import Address

GROUP = "239.255.0.1"
"""The multicast group of discovery."""
LOCALHOST = "127.0.0.1"

DOMAINS = range(233)
"""The domains whose ports are below 65,536."""
PARTICIPANTS = range(120)
"""The participants of one host whose ports are below those of the next domain."""
LOCAL_PARTICIPANTS = range(32)
"""The participants of this host that are announced to, without multicast."""
PEER_PARTICIPANTS = range(4)
"""The participants of a static peer that are announced to."""

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

    def __post_init__(self) -> None:
        if self.domain not in DOMAINS:
            raise ValueError(f"domain {self.domain} is not between 0 and {DOMAINS[-1]}")

    @classmethod
    def from_environment(cls, environ: Mapping[str, str]) -> DomainSettings:
        """Read the settings as ROS does: SUBNET if nothing is said.

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
        peers = environ.get("ROS_STATIC_PEERS", "").split(";")
        return cls(
            domain=int(text),
            discovery_range=DiscoveryRange[word],
            static_peers=tuple(peer.strip() for peer in peers if peer.strip()),
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
    if reach is DiscoveryRange.SUBNET:
        return (GROUP, multicast_port(domain)), *found
    numbers = range(max(number, LOCAL_PARTICIPANTS.stop))
    local = [(LOCALHOST, discovery_port(domain, each)) for each in numbers]
    return (*local, *found)

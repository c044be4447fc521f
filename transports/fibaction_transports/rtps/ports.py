"""The ports of a domain, its settings that ROS reads from the environment, and the UDP sockets."""

from __future__ import annotations

import socket
import struct
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from enum import Enum
from errno import EADDRINUSE
from typing import Final

from msgspec import Struct

from fibaction.words.errors import TransportError
from fibaction_transports.rtps.messages.ids import Address, is_ipv6

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


RECEIVE_BUFFER = 4 * 2**20
"""Bytes that the system is asked to keep for each socket: several samples of a megabyte."""
_EVERYWHERE = {4: "0.0.0.0", 6: "::"}
# Windows binds to no group. Over IPv6, one socket is for both groups.
_GROUP_HOSTS = {4: "" if sys.platform == "win32" else GROUP, 6: "::"}
_LOCAL_NETWORK = 1
_IPV6 = 6
_ALL_GROUPS = frozenset(group for groups in GROUPS.values() for group in groups)


class ParticipantSockets:
    """The sockets of a participant: one for discovery, one for samples, and those of multicast, for
    each version of IP.

    Everything but multicast is sent from the one for discovery.
    """

    def __init__(
        self,
        domain: int,
        *,
        is_local: bool,
        interfaces: Sequence[str],
        ip_versions: Sequence[int] = (4,),
    ) -> None:
        """Open the sockets, at the first free ports of the domain.

        With `is_local`, they are reached from this machine only. The interfaces, by their
        addresses, take part in multicast; none means none.

        Raises:
            TransportError: All ports of the domain are taken, or an interface does not exist.
        """
        self._close = ExitStack()
        self._by_version: dict[int, list[socket.socket]] = {}
        self._by_interface: dict[int, list[socket.socket]] = {version: [] for version in GROUPS}
        self.received: list[socket.socket] = []
        """The sockets at which datagrams arrive."""
        with ExitStack() as undo:
            undo.push(self._close)
            own = LOCALHOSTS if is_local else _EVERYWHERE
            hosts = {version: own[version] for version in ip_versions}
            self.participant = self._open_pairs(domain, hosts)
            """The number of the participant on this host, by its ports."""
            self.sender = self.received[0]
            """The socket that is waited for if there is no room: the last one without room."""
            for version in ip_versions:
                addresses = [each for each in interfaces if _version_of(each) == version]
                if addresses:
                    self._open_multicast(domain, version, addresses)
            undo.pop_all()

    def send(self, datagram: bytes, address: Address) -> None:
        """Send a datagram; one that the system cannot send is lost, as any may be.

        Raises:
            BlockingIOError: The system has no room at the moment.
        """
        senders = self._by_interface if address[0] in _ALL_GROUPS else self._by_version
        for sender in senders.get(_IPV6 if ":" in address[0] else 4, ()):
            try:
                sender.sendto(datagram, address)
            except BlockingIOError:
                self.sender = sender
                raise
            except OSError:
                continue  # such as a network that is not there now

    def close(self) -> None:
        """Close all sockets."""
        self._close.close()

    def _open_pairs(self, domain: int, hosts: Mapping[int, str]) -> int:
        for participant in PARTICIPANTS:
            with ExitStack() as undo:
                ports = discovery_port(domain, participant), data_port(domain, participant)
                try:
                    pairs = {
                        version: [undo.enter_context(_bound((host, port))) for port in ports]
                        for version, host in hosts.items()
                    }
                except OSError as error:
                    if error.errno == EADDRINUSE:
                        continue
                    where = " and ".join(hosts.values())
                    raise TransportError(f"cannot bind to {where}: {error}") from error
                for version, pair in pairs.items():
                    self.received += pair
                    self._by_version[version] = pair[:1]
                self._close.push(undo.pop_all())
                return participant
        raise TransportError(
            f"all ports of domain {domain} are taken: stop other participants, or use another"
            " domain"
        )

    def _open_multicast(self, domain: int, version: int, interfaces: Iterable[str]) -> None:
        receiver = self._close.enter_context(_udp_socket(version))
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # all participants share it
        receiver.bind((_GROUP_HOSTS[version], multicast_port(domain)))
        self.received.append(receiver)
        join = _join_ipv6 if version == _IPV6 else _join
        for interface in interfaces:
            sender = self._close.enter_context(_udp_socket(version))
            try:
                join(receiver, sender, interface)
            except OSError as error:
                raise TransportError(
                    f"{interface!r} is not the address of an interface with multicast: {error}"
                ) from error
            self._by_interface[version].append(sender)


def _join(receiver: socket.socket, sender: socket.socket, interface: str) -> None:
    """Let sockets receive from the group and send to it at the interface with this address."""
    address = socket.inet_aton(interface)
    membership = socket.inet_aton(GROUP) + address
    receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
    sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, address)
    sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, _LOCAL_NETWORK)


def _join_ipv6(receiver: socket.socket, sender: socket.socket, interface: str) -> None:
    """Do the same over IPv6, where an interface has a number."""
    index = _interface_index(interface)
    for group in GROUPS[_IPV6]:
        membership = socket.inet_pton(socket.AF_INET6, group) + struct.pack("@I", index)
        receiver.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, membership)
    sender.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, index)
    sender.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, _LOCAL_NETWORK)
    sender.bind((interface, 0))  # otherwise the address depends on the group


def _interface_index(interface: str) -> int:
    """Return the number of the interface with this address of IPv6, for multicast.

    Raises:
        OSError: There is none.
    """
    for index, _ in socket.if_nameindex():
        with _udp_socket(_IPV6) as probe, suppress(OSError):
            probe.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, index)
            probe.connect((GROUPS[_IPV6][0], multicast_port(0)))
            if probe.getsockname()[0] == interface:
                return index
    raise OSError("no interface sends multicast of IPv6 from it")


def default_interface(version: int = 4) -> str:
    """Return the address of the interface that multicast uses by default; that of the loopback
    interface if this machine has no network.
    """
    with _udp_socket(version) as probe, suppress(OSError):
        # This only looks for the way, and sends nothing.
        probe.connect((GROUPS[version][0], multicast_port(0)))
        return str(probe.getsockname()[0])
    return LOCALHOSTS[version]


def _version_of(host: str) -> int:
    return _IPV6 if is_ipv6(host) else 4


def _udp_socket(version: int) -> socket.socket:
    family = socket.AF_INET6 if version == _IPV6 else socket.AF_INET
    opened = socket.socket(family, socket.SOCK_DGRAM)
    opened.setblocking(False)
    if version == _IPV6:  # the same port of IPv4 has a socket of its own
        opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
    return opened


def _bound(address: Address) -> socket.socket:
    bound = _udp_socket(_version_of(address[0]))
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, RECEIVE_BUFFER)
        bound.bind(address)
    except BaseException:
        bound.close()
        raise
    return bound

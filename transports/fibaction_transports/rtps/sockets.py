"""The UDP sockets of a participant."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, suppress
from errno import EADDRINUSE

from fibaction.words.errors import TransportError
from fibaction_transports.rtps.messages.locators import Address
from fibaction_transports.rtps.ports import (
    GROUP,
    LOCALHOST,
    PARTICIPANTS,
    data_port,
    discovery_port,
    multicast_port,
)

RECEIVE_BUFFER = 4 * 2**20
"""Bytes that the system is asked to keep for each socket: several samples of a megabyte."""
_EVERYWHERE = "0.0.0.0"
_GROUP_HOST = "" if sys.platform == "win32" else GROUP  # Windows binds to no group
_LOCAL_NETWORK = 1


class ParticipantSockets:
    """The sockets of a participant: one for discovery, one for samples, and those of multicast.

    Everything but multicast is sent from the one for discovery.
    """

    def __init__(self, domain: int, *, is_local: bool, interfaces: Sequence[str]) -> None:
        """Open the sockets, at the first free ports of the domain.

        With `is_local`, they are reached from this machine only. The interfaces, by their
        addresses, take part in multicast; none means none.

        Raises:
            TransportError: All ports of the domain are taken, or an interface does not exist.
        """
        self._close = ExitStack()
        self._by_interface: list[socket.socket] = []
        self.received: list[socket.socket] = []
        """The sockets at which datagrams arrive."""
        with ExitStack() as undo:
            undo.push(self._close)
            self.participant = self._open_pair(domain, LOCALHOST if is_local else _EVERYWHERE)
            """The number of the participant on this host, by its ports."""
            if interfaces:
                self._open_multicast(domain, interfaces)
            undo.pop_all()

    def send(self, datagram: bytes, address: Address) -> None:
        """Send a datagram; one that the system cannot send is lost, as any may be.

        Raises:
            BlockingIOError: The system has no room at the moment.
        """
        senders = self._by_interface if address[0] == GROUP else self.received[:1]
        for sender in senders:
            try:
                sender.sendto(datagram, address)
            except BlockingIOError:
                raise
            except OSError:
                continue  # such as a network that is not there now

    @property
    def sender(self) -> socket.socket:
        """The socket from which datagrams are sent."""
        return self.received[0]

    def close(self) -> None:
        """Close all sockets."""
        self._close.close()

    def _open_pair(self, domain: int, host: str) -> int:
        for participant in PARTICIPANTS:
            with ExitStack() as undo:
                ports = discovery_port(domain, participant), data_port(domain, participant)
                try:
                    pair = [undo.enter_context(_bound((host, port))) for port in ports]
                except OSError as error:
                    if error.errno == EADDRINUSE:
                        continue
                    raise TransportError(f"cannot bind to {host}: {error}") from error
                self.received += pair
                self._close.push(undo.pop_all())
                return participant
        raise TransportError(
            f"all ports of domain {domain} are taken: stop other participants, or use another"
            " domain"
        )

    def _open_multicast(self, domain: int, interfaces: Iterable[str]) -> None:
        group = self._close.enter_context(_udp_socket())
        group.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # all participants share it
        group.bind((_GROUP_HOST, multicast_port(domain)))
        self.received.append(group)
        for interface in interfaces:
            sender = self._close.enter_context(_udp_socket())
            try:
                address = socket.inet_aton(interface)
                membership = socket.inet_aton(GROUP) + address
                group.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
                sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, address)
            except OSError as error:
                raise TransportError(
                    f"{interface!r} is not the address of an interface with multicast: {error}"
                ) from error
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, _LOCAL_NETWORK)
            self._by_interface.append(sender)


def default_interface() -> str:
    """Return the address of the interface that multicast uses by default; that of the loopback
    interface if this machine has no network.
    """
    with _udp_socket() as probe, suppress(OSError):
        probe.connect((GROUP, multicast_port(0)))  # only looks for the way, and sends nothing
        return str(probe.getsockname()[0])
    return LOCALHOST


def _udp_socket() -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.setblocking(False)
    return opened


def _bound(address: Address) -> socket.socket:
    bound = _udp_socket()
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, RECEIVE_BUFFER)
        bound.bind(address)
    except BaseException:
        bound.close()
        raise
    return bound

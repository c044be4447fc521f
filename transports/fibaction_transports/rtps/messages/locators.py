"""Locators: the addresses that participants and endpoints announce."""

from __future__ import annotations

import ipaddress
from typing import TypeAlias

from msgspec import Struct

from fibaction_transports.rtps.messages.layout import LITTLE, Layout, Order

Address: TypeAlias = tuple[str, int]
"""A host and a port of UDP."""

UDP_V4, UDP_V6 = 1, 2
_LOCATOR = Layout("iI16s")
_PORTS = range(1, 2**16)


class Locator(Struct, frozen=True):
    """An address of any kind: UDP, shared memory, or what a vendor has added."""

    kind: int
    port: int
    host: bytes
    """16 bytes; an address of IPv4 is the last four."""

    @property
    def udp_address(self) -> Address | None:
        """The address of one host that can be sent to by UDP; None if it is of another kind."""
        if self.port not in _PORTS:
            return None
        host: ipaddress.IPv4Address | ipaddress.IPv6Address
        if self.kind == UDP_V4:
            host = ipaddress.IPv4Address(self.host[12:])
        elif self.kind == UDP_V6:
            host = ipaddress.IPv6Address(self.host)
            if host.ipv4_mapped is not None:
                return None
        else:
            return None
        is_of_many = host.is_multicast or host == _BROADCAST
        return None if host.is_unspecified or is_of_many else (str(host), self.port)


_BROADCAST = ipaddress.IPv4Address("255.255.255.255")


def is_ipv6(host: str) -> bool:
    """Return whether the address of a host is one of IPv6."""
    return ":" in host


def without_scope(host: str) -> str:
    """Return an address without the interface that link-local addresses of IPv6 have."""
    return host.partition("%")[0]


def udp_locator(address: Address) -> Locator:
    """Return the locator of an address."""
    host, port = address
    if is_ipv6(host):
        return Locator(UDP_V6, port, ipaddress.IPv6Address(without_scope(host)).packed)
    return Locator(UDP_V4, port, bytes(12) + ipaddress.IPv4Address(host).packed)


def locator_bytes(locator: Locator) -> bytes:
    """Return a locator as on the wire."""
    return _LOCATOR[LITTLE].pack(locator.kind, locator.port, locator.host)


def read_locator(value: bytes, order: Order) -> Locator:
    """Read a locator.

    Raises:
        struct.error: There are too few bytes.
    """
    return Locator(*_LOCATOR[order].unpack_from(value))

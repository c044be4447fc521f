"""Locators: the addresses that participants and endpoints announce."""

from __future__ import annotations

import ipaddress
from typing import TypeAlias

from msgspec import Struct

from fibaction_transports.rtps.messages.layout import LITTLE, Layout, Order

Address: TypeAlias = tuple[str, int]
"""A host and a port of UDP."""

UDP_V4 = 1
_LOCATOR = Layout("iI16s")
LOCATOR_SIZE = _LOCATOR.size
_PORTS = range(1, 2**16)


class Locator(Struct, frozen=True):
    """An address of any kind: UDP, shared memory, or what a vendor has added."""

    kind: int
    port: int
    host: bytes
    """16 bytes; an address of IPv4 is the last four."""

    @property
    def udp_address(self) -> Address | None:
        """The address that can be sent to by UDP over IPv4; None if it is of another kind."""
        host = ipaddress.IPv4Address(self.host[12:])
        if self.kind != UDP_V4 or self.port not in _PORTS or host.is_unspecified:
            return None
        return None if host.is_multicast or host == _BROADCAST else (str(host), self.port)


_BROADCAST = ipaddress.IPv4Address("255.255.255.255")


def udp_locator(address: Address) -> Locator:
    """Return the locator of an address of IPv4."""
    host, port = address
    return Locator(UDP_V4, port, bytes(12) + ipaddress.IPv4Address(host).packed)


def locator_bytes(locator: Locator, order: Order = LITTLE) -> bytes:
    """Return a locator as on the wire."""
    return _LOCATOR[order].pack(locator.kind, locator.port, locator.host)


def read_locator(value: bytes | memoryview, order: Order, offset: int = 0) -> Locator:
    """Read a locator.

    Raises:
        struct.error: There are too few bytes.
    """
    return Locator(*_LOCATOR[order].unpack_from(value, offset))

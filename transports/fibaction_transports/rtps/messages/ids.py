"""Identifiers of participants, entities and vendors, and the locators at which they are reached."""

from __future__ import annotations

import ipaddress
from typing import TypeAlias

from msgspec import Struct

from fibaction_transports.rtps.messages.layout import LITTLE, Layout, Order

PREFIX_SIZE = 12
GUID_SIZE = 16

UNKNOWN_PREFIX = bytes(PREFIX_SIZE)
"""The prefix that means every participant."""
UNKNOWN_ENTITY = bytes(4)
"""The entity that means every matched reader."""

PARTICIPANT = b"\x00\x00\x01\xc1"
SPDP_WRITER, SPDP_READER = b"\x00\x01\x00\xc2", b"\x00\x01\x00\xc7"
PUBLICATIONS_WRITER, PUBLICATIONS_READER = b"\x00\x00\x03\xc2", b"\x00\x00\x03\xc7"
SUBSCRIPTIONS_WRITER, SUBSCRIPTIONS_READER = b"\x00\x00\x04\xc2", b"\x00\x00\x04\xc7"
LIVELINESS_WRITER, LIVELINESS_READER = b"\x00\x02\x00\xc2", b"\x00\x02\x00\xc7"
TYPE_QUESTIONS_WRITER, TYPE_QUESTIONS_READER = b"\x00\x03\x00\xc3", b"\x00\x03\x00\xc4"
TYPE_ANSWERS_WRITER, TYPE_ANSWERS_READER = b"\x00\x03\x01\xc3", b"\x00\x03\x01\xc4"

KEYLESS_WRITER = 0x03
"""The kind of a user's writer whose topic has no key, as all topics of ROS."""
KEYLESS_READER = 0x04
"""The kind of a user's reader whose topic has no key."""
WRITER_KINDS = (0x02, 0x03)
READER_KINDS = (0x04, 0x07)
BUILTIN = 0xC0
"""The bits of the kind of an entity of discovery."""

FAST_DDS = b"\x01\x0f"
CYCLONE_DDS = b"\x01\x10"
OWN_VENDOR = b"\x01\x7f"
"""The vendor of this implementation, which has no number assigned by the OMG."""


class Guid(bytes):
    """The identifier of an endpoint or a participant: a prefix of 12 bytes and an entity of 4."""

    __slots__ = ()

    @property
    def prefix(self) -> bytes:
        """The participant."""
        return self[:PREFIX_SIZE]

    @property
    def entity(self) -> bytes:
        """The endpoint within its participant."""
        return self[PREFIX_SIZE:]

    @property
    def is_writer(self) -> bool:
        """True for a writer of a user's topic."""
        return self[-1] in WRITER_KINDS

    @property
    def is_reader(self) -> bool:
        """True for a reader of a user's topic."""
        return self[-1] in READER_KINDS

    def __repr__(self) -> str:
        return f"Guid({self.hex()})"

    __str__ = bytes.hex


def is_builtin(entity: bytes) -> bool:
    """Return whether an entity belongs to discovery, and not to a topic of a user."""
    return entity[3] & BUILTIN == BUILTIN


def user_entity(number: int, kind: int) -> bytes:
    """Return the entity of the user's endpoint with this number."""
    return number.to_bytes(3, "big") + bytes([kind])


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

"""Lists of parameters: the data of discovery, and the inline QoS of samples."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from msgspec import Struct

from fibaction_transports.rtps.messages.ids import (
    GUID_SIZE,
    Guid,
    Locator,
    locator_bytes,
    read_locator,
)
from fibaction_transports.rtps.messages.layout import (
    BIG,
    ENCAPSULATION,
    LITTLE,
    LOW,
    U32,
    InvalidPacket,
    Layout,
    Order,
    read_duration,
)

SENTINEL = 0x01
LEASE = 0x02
TOPIC_NAME = 0x05
TYPE_NAME = 0x07
DOMAIN_ID = 0x0F
PROTOCOL_VERSION = 0x15
VENDOR_ID = 0x16
RELIABILITY = 0x1A
LIVELINESS = 0x1B
DURABILITY = 0x1D
OWNERSHIP = 0x1F
DEADLINE = 0x23
LIFESPAN = 0x2B
DESTINATION_ORDER = 0x25
PARTITION = 0x29
USER_DATA = 0x2C
UNICAST_LOCATOR = 0x2F
DEFAULT_UNICAST_LOCATOR = 0x31
METATRAFFIC_UNICAST_LOCATOR = 0x32
HISTORY = 0x40
PARTICIPANT_GUID = 0x50
BUILTIN_ENDPOINTS = 0x58
ENDPOINT_GUID = 0x5A
ENTITY_NAME = 0x62
KEY_HASH = 0x70
STATUS_INFO = 0x71
DATA_REPRESENTATION = 0x73
TYPE_INFORMATION = 0x75
RELATED_SAMPLE_IDENTITY = 0x83
FAST_DDS_RELATED_SAMPLE_IDENTITY = 0x800F
DOMAIN_TAG = 0x4014

MAX_PARAMETERS = 256
"""The most parameters of one list that are read."""
MAX_TEXT = 1024
"""The longest text of a parameter that is read, in bytes."""

_PADDING = 0x00
_MUST_UNDERSTAND = 0x4000
_HEAD = Layout("HH")
_IDENTITY = Layout("16siI")


class SampleIdentity(NamedTuple):
    """A sample of a writer, as a reply names its request; number 0 or less if it is unknown."""

    writer: Guid
    number: int


class Parameters(Struct, frozen=True):
    """A list of parameters as it came, or as it is to be sent. Values are read when asked for.

    Methods raise InvalidPacket for a value that is too short or too long.
    """

    items: tuple[tuple[int, bytes], ...]
    order: Order = LITTLE
    """The byte order of the values."""

    def all(self, pid: int) -> list[bytes]:
        """Return the values of every parameter with this ID."""
        return [value for found, value in self.items if found == pid]

    def octets(self, pid: int, size: int) -> bytes | None:
        """Return the first bytes of a parameter; None if it is absent."""
        for found, value in self.items:
            if found == pid:
                if len(value) < size:
                    raise InvalidPacket(f"parameter {pid:#x} has {len(value)} of {size} bytes")
                return value[:size]
        return None

    def u32(self, pid: int, default: int) -> int:
        """Return a number of four bytes."""
        value = self.octets(pid, U32.size)
        return default if value is None else int(U32[self.order].unpack(value)[0])

    def guid(self, pid: int) -> Guid | None:
        """Return an identifier; None if it is absent."""
        value = self.octets(pid, GUID_SIZE)
        return None if value is None else Guid(value)

    def duration(self, pid: int, default: float, offset: int = 0) -> float:
        """Return the seconds that begin at the offset of a parameter."""
        value = self.octets(pid, offset + 8)
        return default if value is None else read_duration(value[offset:], self.order)

    def blob(self, pid: int) -> bytes | None:
        """Return a sequence of bytes, which begins with its length; None if it is absent."""
        value = self.octets(pid, U32.size)
        if value is None:
            return None
        size = U32[self.order].unpack(value)[0]
        if size > MAX_TEXT:
            raise InvalidPacket(f"parameter {pid:#x} of {size} bytes exceeds {MAX_TEXT} bytes")
        whole = self.octets(pid, U32.size + size)
        return None if whole is None else whole[U32.size :]

    def text(self, pid: int) -> str | None:
        """Return a text; None if it is absent."""
        blob = self.blob(pid)
        return None if blob is None else _decoded(pid, blob)

    def texts(self, pid: int) -> list[str]:
        """Return the texts of a parameter that is a sequence of texts."""
        value = self.octets(pid, U32.size)
        if value is None:
            return []
        value, place, found = self.all(pid)[0], U32.size, list[str]()
        for _ in range(min(U32[self.order].unpack_from(value)[0], MAX_PARAMETERS)):
            inner = Parameters(((pid, value[place:]),), self.order)
            blob = inner.blob(pid) or b""
            found.append(_decoded(pid, blob))
            place += U32.size + len(blob) + -len(blob) % 4
        return found

    def locators(self, pid: int) -> list[Locator]:
        """Return the locators of every parameter with this ID."""
        try:
            return [read_locator(value, self.order) for value in self.all(pid)]
        except struct.error as error:
            raise InvalidPacket(f"locator of parameter {pid:#x} is too short") from error

    def identity(self, pid: int) -> SampleIdentity | None:
        """Return the sample that a parameter names; None if it is absent."""
        value = self.octets(pid, _IDENTITY.size)
        if value is None:
            return None
        guid, high, low = _IDENTITY[self.order].unpack(value)
        return SampleIdentity(Guid(guid), (high << 32) | low)


def _decoded(pid: int, blob: bytes) -> str:
    try:
        return blob.partition(b"\0")[0].decode()
    except UnicodeDecodeError as error:
        raise InvalidPacket(f"text of parameter {pid:#x} is not UTF-8") from error


def read_parameters(
    data: bytes | memoryview, order: Order, offset: int = 0
) -> tuple[Parameters, int]:
    """Read the list that begins at the offset; return it and the place after its end.

    Raises:
        InvalidPacket: The list has no end, or too many parameters.
    """
    items = list[tuple[int, bytes]]()
    head = _HEAD[order]
    for _ in range(MAX_PARAMETERS + 1):
        if offset + head.size > len(data):
            break
        pid, size = head.unpack_from(data, offset)
        offset += head.size
        if pid == SENTINEL:
            return Parameters(tuple(items), order), offset
        if offset + size > len(data):
            raise InvalidPacket(f"parameter {pid:#x} of {size} bytes is longer than its list")
        if pid != _PADDING:
            known = pid if pid == DOMAIN_TAG else pid & ~_MUST_UNDERSTAND
            items.append((known, bytes(data[offset : offset + size])))
        offset += size
    raise InvalidPacket(f"list of parameters has no end within {MAX_PARAMETERS} parameters")


def parameters_bytes(parameters: Parameters) -> bytes:
    """Return a list of parameters as on the wire, with its end."""
    head, parts = _HEAD[parameters.order], list[bytes]()
    for pid, value in parameters.items:
        padding = bytes(-len(value) % 4)
        parts += (head.pack(pid, len(value) + len(padding)), value, padding)
    parts.append(head.pack(SENTINEL, 0))
    return b"".join(parts)


def blob_value(data: bytes) -> bytes:
    """Return the value of a parameter that is a sequence of bytes."""
    return U32[LITTLE].pack(len(data)) + data


def text_value(text: str) -> bytes:
    """Return the value of a parameter that is a text."""
    return blob_value(text.encode() + b"\0")


def identity_value(identity: SampleIdentity) -> bytes:
    """Return the value of a parameter that names a sample."""
    return identity.writer + struct.pack("<iI", identity.number >> 32, identity.number & LOW)


def locator_items(pid: int, locators: Iterable[Locator]) -> Sequence[tuple[int, bytes]]:
    """Return a parameter for each locator."""
    return [(pid, locator_bytes(locator)) for locator in locators]


_LITTLE_LIST = b"\x00\x03\x00\x00"
_ORDERS: dict[bytes, Order] = {b"\x00\x02": BIG, b"\x00\x03": LITTLE}


def list_payload(parameters: Parameters) -> bytes:
    """Return a little-endian list of parameters as a payload."""
    return _LITTLE_LIST + parameters_bytes(parameters)


def read_list(payload: bytes | memoryview) -> Parameters:
    """Read a payload that is a list of parameters.

    Raises:
        InvalidPacket: It is something else, or the list is broken.
    """
    order = _ORDERS.get(bytes(payload[:2]))
    if order is None:
        raise InvalidPacket(f"encapsulation {bytes(payload[:2]).hex()} is not a list of parameters")
    return read_parameters(payload, order, ENCAPSULATION)[0]

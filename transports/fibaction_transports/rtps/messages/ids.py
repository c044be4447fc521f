"""Identifiers of RTPS: participants, entities, and vendors."""

from __future__ import annotations

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

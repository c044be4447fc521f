"""Types of XTypes as other participants tell them: structs, with the names of their fields.

Messages of ROS are structs of numbers, texts, other structs, and sequences and arrays of these.
Everything else that XTypes has is an error. The numbers of types are those of ROS here.
"""

from __future__ import annotations

import struct
from typing import Final, NamedTuple

from fibaction_transports.ros2.without_ros.descriptions.description_messages import (
    FieldTypeDescription,
    UnusableDescription,
)

MOST_PARTS: Final = 1_000
"""Types in an answer, and fields in a type."""

_COMPLETE, _STRUCT = 0xF2, 0x51
_HASH_SIZE = 14
_NUMBERS = {1: 15, 2: 16, 3: 4, 4: 6, 5: 8, 6: 5, 7: 7, 8: 9, 9: 10, 10: 11, 12: 2, 13: 3}
"""The numbers of ROS for simple types, by those of XTypes."""
_TEXT_KINDS = {0x70: ("B", 17, 21), 0x71: ("I", 17, 21), 0x72: ("B", 18, 22), 0x73: ("I", 18, 22)}
"""The form of the bound of a text, and the numbers of ROS without a bound and with one."""
_SEQUENCE_KINDS = {0x80: "B", 0x81: "I"}
_ARRAY_KINDS = {0x90: "B", 0x91: "I"}
_OTHER_STRUCT, _ARRAY, _BOUNDED, _UNBOUNDED = 1, 48, 96, 144


class ObjectField(NamedTuple):
    """A field of a struct."""

    name: str
    type: FieldTypeDescription
    nested: bytes
    """The ID of its type if that is a struct, or of its elements; empty otherwise."""


class TypeObject(NamedTuple):
    """A struct."""

    name: str
    """As DDS has it, for example `std_msgs::msg::dds_::String_`."""
    fields: list[ObjectField]


def read_types(data: bytes) -> dict[bytes, TypeObject]:
    """Read the types of an answer, by their IDs.

    Raises:
        UnusableDescription: The answer is broken, or has a type that ROS does not have.
    """
    reader = _Reader(data)
    try:
        return dict(_read_type(reader) for _ in range(reader.count()))
    except (struct.error, UnicodeDecodeError) as exc:
        raise UnusableDescription("the types of its answer are broken") from exc


class _Reader:
    """Numbers and texts, one after another, aligned as in CDR of version 2."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.place = 0

    def number(self, form: str) -> int:
        size = struct.calcsize(form)
        self.place += -self.place % size
        (found,) = struct.unpack_from(f"<{form}", self._data, self.place)
        self.place += size
        return int(found)

    def count(self) -> int:
        found = self.number("I")
        if found > MOST_PARTS:
            raise UnusableDescription(f"it has more than {MOST_PARTS:,} types or fields")
        return found

    def take(self, size: int) -> bytes:
        (found,) = struct.unpack_from(f"{size}s", self._data, self.place)
        self.place += size
        return bytes(found)

    def text(self) -> str:
        return self.take(self.number("I")).partition(b"\0")[0].decode()

    def end(self) -> int:
        """Read the size of what follows, and return its end."""
        size = self.number("I")
        return self.place + size

    def expect(self, form: str, *expected: int) -> None:
        for one in expected:
            if self.number(form) != one:
                raise UnusableDescription("it has a type that ROS does not have")


def _read_type(reader: _Reader) -> tuple[bytes, TypeObject]:
    type_id = reader.take(1 + _HASH_SIZE)
    end = reader.end()
    reader.expect("B", _COMPLETE, _STRUCT)
    reader.number("H")  # flags
    end_of_head = reader.end()
    reader.expect("B", 0, 0, 0)  # neither a base, nor annotations
    name = reader.text()
    reader.place = end_of_head
    reader.end()
    fields = [_read_field(reader) for _ in range(reader.count())]
    reader.place = end
    return type_id, TypeObject(name, fields)


def _read_field(reader: _Reader) -> ObjectField:
    end = reader.end()
    reader.number("I")  # its ID
    reader.number("H")  # flags
    described, nested = _read_field_type(reader)
    name = reader.text()
    reader.place = end
    return ObjectField(name, described, nested)


def _read_field_type(reader: _Reader) -> tuple[FieldTypeDescription, bytes]:
    kind = reader.number("B")
    if kind in _SEQUENCE_KINDS or kind in _ARRAY_KINDS:
        reader.number("B")
        reader.number("H")  # flags
        if kind in _ARRAY_KINDS:
            reader.expect("I", 1)  # its dimensions
            capacity, added = reader.number(_ARRAY_KINDS[kind]), _ARRAY
        else:
            capacity = reader.number(_SEQUENCE_KINDS[kind])
            added = _BOUNDED if capacity else _UNBOUNDED
        element, nested = _read_element(reader, reader.number("B"))
        element.type_id += added
        element.capacity = capacity
        return element, nested
    return _read_element(reader, kind)


def _read_element(reader: _Reader, kind: int) -> tuple[FieldTypeDescription, bytes]:
    if kind == _COMPLETE:
        return FieldTypeDescription(_OTHER_STRUCT), bytes([kind]) + reader.take(_HASH_SIZE)
    if kind in _TEXT_KINDS:
        form, free, bounded = _TEXT_KINDS[kind]
        capacity = reader.number(form)
        found = FieldTypeDescription(bounded if capacity else free, string_capacity=capacity)
        return found, b""
    if kind not in _NUMBERS:
        raise UnusableDescription("it has a type that ROS does not have")
    return FieldTypeDescription(_NUMBERS[kind]), b""

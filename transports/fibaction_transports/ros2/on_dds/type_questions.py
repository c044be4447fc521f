"""The questions of a node about the types of actions, by TypeLookup of XTypes, and the types in the
answers: structs, with the names of their fields.

Messages of ROS are structs of numbers, texts, other structs, and sequences and arrays of these.
Everything else that XTypes has is an error. The numbers of types are those of ROS here.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import anyio

from fibaction_transports.ros2.node.parts import EndInfo
from fibaction_transports.ros2.node.rivals import PARTICIPANT
from fibaction_transports.ros2.without_ros.descriptions.described_types import (
    FieldDescription,
    FieldTypeDescription,
    IndividualTypeDescription,
    UnusableDescription,
)
from fibaction_transports.ros2.without_ros.descriptions.type_learner import ActionQuestions
from fibaction_transports.ros2.without_ros.messages.message_type import ros_type
from fibaction_transports.rtps.events import TypesAnswered

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


AT_ONCE: Final = 10
"""Types in one question."""
MOST_TYPES: Final = 300
"""Types that an action may nest."""


class TypeQuestions(ActionQuestions):
    """The questions of a node about types, by TypeLookup of XTypes.

    Nodes on Fast DDS 3, as of ROS 2 Kilted, tell the types of all messages in this way, those of
    requests and answers among them: so goals and results, too.
    """

    def __init__(self, ask: Callable[[bytes, Sequence[bytes]], int]) -> None:
        """`ask` sends a question to a participant, and returns its number, or 0 if it cannot."""
        self._ask = ask
        self._waiting: dict[int, tuple[bytes, anyio.Event]] = {}
        self._answers: dict[int, bytes] = {}

    def take(self, event: TypesAnswered) -> None:
        """Take an answer, if it is waited for."""
        prefix, is_answered = self._waiting.get(event.number, (b"", None))
        if is_answered is not None and prefix == event.prefix:
            self._answers[event.number] = event.types
            is_answered.set()

    def can_ask(self, ends: Sequence[EndInfo]) -> bool:
        type_ids = {one.type_id for one in ends}
        return len(type_ids) == len(ends) and b"" not in type_ids

    async def look_up(
        self, ends: Sequence[EndInfo], type_name: str
    ) -> dict[str, IndividualTypeDescription]:
        prefix = ends[0].gid[PARTICIPANT]
        known: dict[bytes, TypeObject] = {}
        wanted = dict.fromkeys(one.type_id for one in ends)
        while missing := [one for one in wanted if one not in known][:AT_ONCE]:
            found = read_types(await self._answer(prefix, missing))
            for one in missing:
                if one not in found:
                    raise UnusableDescription("it does not tell a type that it was asked for")
                known[one] = found[one]
                wanted |= {field.nested: None for field in found[one].fields if field.nested}
            if len(wanted) > MOST_TYPES:
                raise UnusableDescription(f"it nests more than {MOST_TYPES} types")
        return {ros_type(one.name): _described(one, known) for one in known.values()}

    async def _answer(self, prefix: bytes, type_ids: Sequence[bytes]) -> bytes:
        number = self._ask(prefix, type_ids)
        if not number:
            raise UnusableDescription("its participant does not answer questions about types")
        is_answered = anyio.Event()
        self._waiting[number] = prefix, is_answered
        try:
            await is_answered.wait()
            return self._answers[number]
        finally:
            del self._waiting[number]
            self._answers.pop(number, None)


def _described(found: TypeObject, known: dict[bytes, TypeObject]) -> IndividualTypeDescription:
    fields: list[FieldDescription] = []
    for name, field_type, nested in found.fields:
        if nested:
            field_type.nested_type_name = ros_type(known[nested].name)
        fields.append(FieldDescription(name, field_type))
    return IndividualTypeDescription(ros_type(found.name), fields)

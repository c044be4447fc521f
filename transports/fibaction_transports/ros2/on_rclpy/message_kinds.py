"""The kinds of ROS's generated classes, and of their fields.

These classes check little or nothing, and their C code asserts, or cuts values off. A message has a
`byte` as `bytes` of length 1, several of them as a list, and a fixed number of numbers as an array
of numpy.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any, cast

import msgspec

from fibaction.interfaces.ros_types import struct
from fibaction.words.errors import TransportError
from fibaction_transports.ros2.convert.arrays import numpy
from fibaction_transports.ros2.convert.fields import (
    SINGLES,
    ArrayKind,
    Kind,
    Number,
    Numbers,
    Octet,
    Part,
    Unfit,
    array_kind,
    text_kind,
)
from fibaction_transports.ros2.convert.message_types import DurationKind, MessageKind, TimeKind
from fibaction_transports.ros2.convert.schemas import Option, UserSchema

_definition: Any = import_module("rosidl_parser.definition")

_SPECIAL = {"Time": TimeKind, "Duration": DurationKind}
_OCTETS = [bytes([number]) for number in range(256)]


@cache
def message_kind(cls: Any) -> MessageKind:
    """Return the kind of a generated class.

    Raises:
        TransportError: It has a field that ROS's own Python code cannot handle.
    """
    package, folder = cls.__module__.split(".")[:2]
    text = f"{package}/{cls.__name__}"
    slots = zip(cls.get_fields_and_field_types(), cls.SLOT_TYPES, strict=True)
    fields = {name: _kind_of(slot, f"{text}.{name}") for name, slot in slots}
    default = _struct(cls, fields, text, f"{package}.{folder}")
    special = _SPECIAL if package == "builtin_interfaces" else {}
    return special.get(cls.__name__, MessageKind)(text, cls, fields, default)


def _struct(cls: Any, kinds: dict[str, Kind], text: str, module: str) -> type[msgspec.Struct]:
    """Return a struct with the fields, the defaults and the constants of a message."""
    message = cls()
    fields: list[tuple[str, Any, Any]] = []
    for name, kind in kinds.items():
        read = kind.bind(UserSchema(None), name, []).read
        value = getattr(message, name)
        fields.append((name, kind.default, value if read is None else read(value)))
    return struct(
        cls.__name__,
        fields,
        module=module,
        doc=f"`{text}` of ROS 2.",
        constants=_constants(cls),
    )


def _constants(cls: Any) -> dict[str, Any]:
    metaclass = cast("type[object]", type(cls))
    # The metaclass has a property for each constant, and one for each default of a field.
    constants = {
        name: getattr(cls, name)
        for name, member in vars(metaclass).items()
        if isinstance(member, property) and not name.endswith("__DEFAULT")
    }
    # A `byte` is an int for users, as in a field.
    return {name: ord(one) if isinstance(one, bytes) else one for name, one in constants.items()}


class _RclpyOctet(Octet):
    """A `byte`: `bytes` of length 1 in a message."""

    def match(self, option: Option, path: str, problems: list[str]) -> Part:
        return Part(self.decoded, _octet, None if option.word == "bytes" else ord)


def _octet(value: int | bytes) -> bytes:
    return _OCTETS[value] if isinstance(value, int) else value


class _RclpyOctets(ArrayKind):
    """Several `byte`s: a list of `bytes` of length 1 in a message."""

    words = ("array", "bytes")

    def part(self, option: Option, element: Part) -> Part:
        listed = super().part(option, element)
        return Part(
            self.limited(bytes) | listed.decoded,
            _octets,
            listed.read if option.word == "array" else _joined,
        )


def _octets(values: list[int | bytes] | bytes) -> list[bytes]:
    if isinstance(values, bytes):
        return [_OCTETS[value] for value in values]
    return [_octet(value) for value in values]


def _joined(octets: list[bytes]) -> bytes:
    return bytes(map(ord, octets))  # a third of the time of `join` for a million


class _FixedNumbers(Numbers):
    """A fixed number of numbers: an array of numpy in a message."""

    def made(self, packed: msgspec.Raw) -> Any:
        return numpy().array(super().made(packed), self.number.dtype)


def _text(value: str) -> str:
    # ROS's C code would silently cut the string off there.
    if "\0" in value:
        raise Unfit("Expected `str` without a NUL")
    return value


_SINGLES: dict[str, Kind] = {
    **SINGLES,
    "boolean": SINGLES["bool"],
    "octet": _RclpyOctet(),
    "float": SINGLES["float32"],
    "double": SINGLES["float64"],
}
"""The basic types that ROS's Python can handle, by their names in `rosidl_parser.definition`."""


def _kind_of(slot: Any, where: str) -> Kind:
    """Return the kind of a field from ROS's description of its type."""
    if isinstance(slot, _definition.AbstractNestedType):
        element = _kind_of(slot.value_type, where)
        size = slot.size if isinstance(slot, _definition.Array) else None
        bounded = isinstance(slot, _definition.BoundedSequence)
        return _many(element, size, slot.maximum_size if bounded else None)
    if isinstance(slot, _definition.AbstractGenericString):
        bound = slot.maximum_size if slot.has_maximum_size() else None
        wide = isinstance(slot, _definition.AbstractWString)
        return text_kind(wide, bound, None if wide else _text)
    if isinstance(slot, _definition.NamespacedType):
        return message_kind(getattr(import_module(".".join(slot.namespaces)), slot.name))
    if slot.typename in _SINGLES:
        return _SINGLES[slot.typename]
    raise TransportError(f"{where} is a {slot.typename}, which ROS itself cannot handle in Python")


def _many(element: Kind, size: int | None, bound: int | None) -> ArrayKind:
    if isinstance(element, Number) and size is not None:
        return _FixedNumbers(element, size, bound)
    if isinstance(element, Octet):
        return _RclpyOctets(element, size, bound)
    return array_kind(element, size, bound)

"""The kinds of ROS's generated classes, and of their fields.

They are made from what a class says of its fields, `get_fields_and_field_types()`, so no module of
ROS is imported but that of a nested message.

These classes check little or nothing, and their C code asserts, or cuts values off. A message has a
`byte` as `bytes` of length 1, several of them as a list, and a fixed number of numbers as an array
of numpy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from typing import Any, cast

import msgspec

from fibaction.interfaces.ros_types import struct
from fibaction.types.ros_messages import numpy
from fibaction.words.errors import TransportError
from fibaction_transports.ros2.convert.conversion import RosCodec
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
    described: dict[str, str] = cls.get_fields_and_field_types()
    fields = {name: _kind_of(kind, f"{text}.{name}") for name, kind in described.items()}
    default = _struct(cls, fields, text, f"{package}/{folder}/{cls.__name__}")
    special = _SPECIAL if package == "builtin_interfaces" else {}
    return special.get(cls.__name__, MessageKind)(text, cls, fields, default)


def _struct(cls: Any, kinds: dict[str, Kind], text: str, ros_type: str) -> type[msgspec.Struct]:
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
        module=__name__,
        doc=f"`{text}` of ROS 2.",
        constants=_constants(cls),
        ros_type=ros_type,
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


class _ClassOctet(Octet):
    """A `byte`: `bytes` of length 1 in a message."""

    def match(self, option: Option, path: str, problems: list[str]) -> Part:
        return Part(self.decoded, _octet, None if option.word == "bytes" else ord)


def _octet(value: int | bytes) -> bytes:
    return _OCTETS[value] if isinstance(value, int) else value


class _ClassOctets(ArrayKind):
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


_CLASS_SINGLES: dict[str, Kind] = {
    **SINGLES,
    "boolean": SINGLES["bool"],
    "octet": _ClassOctet(),
    "float": SINGLES["float32"],
    "double": SINGLES["float64"],
}
"""The basic types that ROS's Python can handle, by the names that its classes have for them."""
_SEQUENCE, _TEXT = "sequence<", ("string", "wstring")


def _kind_of(text: str, where: str) -> Kind:
    """Return the kind of a field from its type in the words of a class: `sequence<double, 3>`."""
    if text.startswith(_SEQUENCE):
        inner = text.removeprefix(_SEQUENCE).removesuffix(">")
        element, _, bound = inner.rpartition(", ")
        return _many(_kind_of(element or bound, where), None, int(bound) if element else None)
    if text.endswith("]"):
        element, _, size = text.removesuffix("]").rpartition("[")
        return _many(_kind_of(element, where), int(size), None)
    name, _, rest = text.partition("<")
    if name in _TEXT:
        is_wide = name == "wstring"
        bound = rest.removesuffix(">")
        return text_kind(is_wide, int(bound) if bound else None, None if is_wide else _text)
    if "/" in text:
        package, _, name = text.partition("/")
        return message_kind(getattr(import_module(f"{package}.msg"), name))
    if text in _CLASS_SINGLES:
        return _CLASS_SINGLES[text]
    raise TransportError(f"{where} is a {text}, which ROS itself cannot handle in Python")


def _many(element: Kind, size: int | None, bound: int | None) -> ArrayKind:
    if isinstance(element, Number) and size is not None:
        return _FixedNumbers(element, size, bound)
    if isinstance(element, Octet):
        return _ClassOctets(element, size, bound)
    return array_kind(element, size, bound)


class ClassCodec:
    """A class of ROS, as any action uses it."""

    def __init__(self, cls: Any) -> None:
        """Describe a class.

        Raises:
            TransportError: It has a field that ROS's own Python code cannot handle.
        """
        self._kind = message_kind(cls)
        self.struct = self._kind.default
        """A struct with its fields, defaults and constants."""
        part: Any = self._kind.bind(UserSchema(None), "", [])
        self.decode: Callable[[bytes], Any] = RosCodec(part).to_ros

    def reader(self, schema: Mapping[str, Any]) -> Callable[[Any], Any]:
        """Return a function that turns a message into plain data that fits this JSON Schema.

        Raises:
            TypeError: The type does not match; the text lists the fields.
        """
        problems: list[str] = []
        read = self._kind.bind(UserSchema(schema), "$", problems).read
        if read is None:
            raise TypeError("; ".join(problems))
        return read

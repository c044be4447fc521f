"""The types of ROS messages: the fields of the generated classes, and msgspec structs like them.

A message type is analysed once, and bound once to each type of a user that is used with it.
"""

from __future__ import annotations

import base64
import datetime
from functools import cache, partial
from importlib import import_module
from typing import Annotated, Any, NamedTuple, cast

import msgspec
from msgspec import Meta

from fibaction.interfaces.ros_types import struct
from fibaction.words.errors import TransportError
from fibaction_transports.ros2.convert.fields import (
    SINGLES,
    ArrayKind,
    Convert,
    Kind,
    Number,
    Numbers,
    Octet,
    Octets,
    Part,
    Unfit,
    text_kind,
)
from fibaction_transports.ros2.convert.schemas import MISSING, Option, UserSchema

_definition: Any = import_module("rosidl_parser.definition")

_NIL = 0xC0  # null in msgpack
_BILLION = 10**9
_EPOCH = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
_AWARE = Annotated[datetime.datetime, Meta(tz=True)]

_encode = msgspec.msgpack.Encoder().encode


class BoundField(NamedTuple):
    """A field of a message, bound to the type that the user's end expects."""

    name: str
    part: Part
    nullable: bool
    """True if null may stand for ROS's default of the field."""


class MessagePart(Part):
    """A message, with the types that the user's end expects in its fields."""

    def __init__(self, cls: Any, fields: list[BoundField], decoded: Any) -> None:
        super().__init__(decoded, self.made, self.values)
        self.cls = cls
        self.fields = fields
        self._readers = [(field.name, field.part.read) for field in fields]

    def made(self, value: Any) -> Any:
        """Make a message from a decoded value.

        Raises:
            Unfit: A value does not fit its field.
        """
        message = self.cls()
        self.fill(message, value)
        return message

    def put(self, message: Any, name: str, value: Any) -> None:
        self.fill(getattr(message, name), value)

    def fill(self, message: Any, value: Any) -> None:
        """Set the fields of a message to decoded values. Fields that are left out are not changed.

        Raises:
            Unfit: A value does not fit its field.
        """
        for name, part, nullable in self.fields:
            new = getattr(value, name)
            if new is None or (nullable and _is_nil(new)):
                continue
            try:
                part.put(message, name, new)
            except Unfit as exc:
                raise exc.under(f".{name}") from None
            except AssertionError as exc:  # with ROS_PYTHON_CHECK_FIELDS=1, ROS checks, too
                raise Unfit(str(exc), f".{name}") from None

    def values(self, message: Any) -> dict[str, Any]:
        """Return the fields of a message by name, as msgspec can encode them."""
        return {
            name: getattr(message, name) if read is None else read(getattr(message, name))
            for name, read in self._readers
        }


def _is_nil(value: Any) -> bool:
    # msgspec has no type for "anything as it is in the payload, or None".
    return isinstance(value, msgspec.Raw) and memoryview(value)[0] == _NIL


class TimePart(MessagePart):
    """A `Time` that may also be a datetime, or a `Duration` that may also be a timedelta."""

    def __init__(self, fields: MessagePart, also: Any, read: Convert) -> None:
        """`also` is the second type that is decoded. `read`, if not None, converts to it."""
        super().__init__(fields.cls, fields.fields, fields.decoded | also)
        if read is not None:
            self.read = read

    def fill(self, message: Any, value: Any) -> None:
        if isinstance(value, datetime.datetime):
            value -= _EPOCH
        if not isinstance(value, datetime.timedelta):
            super().fill(message, value)
            return
        seconds = value.days * 86400 + value.seconds
        if not -(2**31) <= seconds < 2**31:
            raise Unfit("Expected a time within 2**31 seconds")
        message.sec = seconds
        message.nanosec = value.microseconds * 1000


def _moment(time: Any) -> str:
    """Return a `Time` as text (RFC 3339), which msgspec also decodes as a datetime."""
    seconds, nanoseconds = divmod(time.sec * _BILLION + time.nanosec, _BILLION)
    whole = _EPOCH + datetime.timedelta(seconds=seconds)
    return f"{whole:%Y-%m-%dT%H:%M:%S}.{nanoseconds:09}Z"


def _span(duration: Any) -> datetime.timedelta:
    # To the nearest microsecond, as msgspec decodes a time.
    microseconds = (duration.nanosec + 500) // 1000
    return datetime.timedelta(seconds=duration.sec, microseconds=microseconds)


class MessageKind(Kind):
    """A message: a struct with named fields."""

    words: tuple[str, ...] = ("object",)

    def __init__(self, cls: Any) -> None:
        """Analyse a generated class.

        Raises:
            TransportError: It has a field that ROS's own Python code cannot handle.
        """
        self.cls = cls
        package, folder = cls.__module__.split(".")[:2]
        self.text = f"{package}/{cls.__name__}"
        self.noun = f"the struct {self.text}"
        slots = zip(cls.get_fields_and_field_types(), cls.SLOT_TYPES, strict=True)
        self.fields = {name: _kind_of(slot, f"{self.text}.{name}") for name, slot in slots}
        self.default = self._struct(f"{package}.{folder}")

    def _struct(self, module: str) -> type[msgspec.Struct]:
        """Return a struct with the fields, the defaults and the constants of the message."""
        message = self.cls()
        fields: list[tuple[str, Any, Any]] = []
        for name, kind in self.fields.items():
            read = kind.bind(UserSchema(None), name, []).read
            value = getattr(message, name)
            fields.append((name, kind.default, value if read is None else read(value)))
        return struct(
            self.cls.__name__,
            fields,
            module=module,
            doc=f"`{self.text}` of ROS 2.",
            constants=_constants(self.cls),
        )

    def match(self, option: Option, path: str, problems: list[str]) -> Part:
        fields: list[BoundField] = []
        decoded: list[tuple[str, Any, Any]] = []
        for name, kind in self.fields.items():
            wanted = option.field(name)
            if wanted is None:
                problems.append(f"{path}.{name} ({kind.text}): the action has no such field")
                continue
            part = kind.bind(wanted, f"{path}.{name}", problems)
            fields.append(BoundField(name, part, wanted.nullable))
            # A `Raw` may be null already: see `_is_nil`.
            nullable = wanted.nullable and part.decoded is not msgspec.Raw
            type_ = part.decoded | None if nullable else part.decoded
            decoded.append((name, type_, _left_out(part, wanted)))
        strange = [name for name in option.names if name not in self.fields]
        problems.extend(f"{path}.{name}: the ROS type has no such field" for name in strange)
        if problems:
            return Part(Any)
        struct = msgspec.defstruct(
            self.cls.__name__, decoded, forbid_unknown_fields=True, kw_only=True
        )
        return MessagePart(self.cls, fields, struct)


class TimeKind(MessageKind):
    """`builtin_interfaces/Time`."""

    # The schema of a datetime is often that of a string.
    words = ("object", "string", "datetime")

    def match(self, option: Option, path: str, problems: list[str]) -> Part:
        part = super().match(option, path, problems)
        if not isinstance(part, MessagePart):
            return part
        return TimePart(part, _AWARE, _moment if option.word in self.words[1:] else None)


class DurationKind(MessageKind):
    """`builtin_interfaces/Duration`."""

    words = ("object", "timedelta")

    def match(self, option: Option, path: str, problems: list[str]) -> Part:
        part = super().match(option, path, problems)
        if not isinstance(part, MessagePart):
            return part
        return TimePart(part, datetime.timedelta, _span if option.word in self.words[1:] else None)


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


def _left_out(part: Part, wanted: UserSchema) -> Any:
    """Return the value of a field that a payload leaves out; None stands for ROS's default.

    The user's default takes precedence over ROS's, because a type of the user may leave out fields
    that have their defaults.
    """
    default = wanted.default
    if default is MISSING or (default is None and wanted.nullable):
        return None
    try:
        if isinstance(default, str) and any(option.word == "bytes" for option in wanted.options):
            default = base64.b64decode(default)
        decode = partial(msgspec.msgpack.Decoder(part.decoded).decode, _encode(default))
        value = decode()
        if part.make is not None:  # it checks the value, too
            part.make(value)
    except (msgspec.MsgspecError, ValueError, OverflowError, TypeError):
        return msgspec.NODEFAULT  # ROS cannot hold the default, so the field must be given
    return msgspec.field(default_factory=decode)


@cache
def message_kind(cls: Any) -> MessageKind:
    """Return the kind of a generated class.

    Raises:
        TransportError: It has a field that ROS's own Python code cannot handle.
    """
    special = {"Time": TimeKind, "Duration": DurationKind}
    if cls.__module__.startswith("builtin_interfaces."):
        return special.get(cls.__name__, MessageKind)(cls)
    return MessageKind(cls)


def _kind_of(slot: Any, where: str) -> Kind:
    """Return the kind of a field from ROS's description of its type."""
    if isinstance(slot, _definition.AbstractNestedType):
        element = _kind_of(slot.value_type, where)
        size = slot.size if isinstance(slot, _definition.Array) else None
        bounded = isinstance(slot, _definition.BoundedSequence)
        return _many(element, size, slot.maximum_size if bounded else None)
    if isinstance(slot, _definition.AbstractGenericString):
        bound = slot.maximum_size if slot.has_maximum_size() else None
        return text_kind(isinstance(slot, _definition.AbstractWString), bound)
    if isinstance(slot, _definition.NamespacedType):
        return message_kind(getattr(import_module(".".join(slot.namespaces)), slot.name))
    if slot.typename in SINGLES:
        return SINGLES[slot.typename]
    raise TransportError(f"{where} is a {slot.typename}, which ROS itself cannot handle in Python")


def _many(element: Kind, size: int | None, bound: int | None) -> ArrayKind:
    if isinstance(element, Number):
        return Numbers(element, size, bound)
    if isinstance(element, Octet):
        return Octets(size, bound)
    return ArrayKind(element, size, bound)

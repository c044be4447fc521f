"""ROS messages: what their generated classes say of their fields, and structs of msgspec like them.

Everything is worked out once for each message type, and once for each type of a user that meets it.
"""

from __future__ import annotations

import base64
import datetime
from functools import cache, partial
from importlib import import_module
from typing import Annotated, Any, NamedTuple, cast

import msgspec
from msgspec import Meta

from fibaction.exceptions import TransportError
from fibaction.ros_types import struct
from fibaction_transports.ros2.fields import (
    SINGLES,
    Convert,
    Kind,
    Many,
    Number,
    Numbers,
    Octet,
    Octets,
    Part,
    Unfit,
    text_kind,
)
from fibaction_transports.ros2.schemas import MISSING, Option, Schema

_definition: Any = import_module("rosidl_parser.definition")

_NIL = 0xC0  # null in msgpack
_BILLION = 10**9
_EPOCH = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
_AWARE = Annotated[datetime.datetime, Meta(tz=True)]

_encode = msgspec.msgpack.Encoder().encode


class Field(NamedTuple):
    """A field of a message, bound to what the user's end expects."""

    name: str
    part: Part
    nullable: bool
    """Whether null may stand for what ROS has in the field by default."""


class MessagePart(Part):
    """A message, and what the user's end expects of its fields."""

    def __init__(self, cls: Any, fields: list[Field], decoded: Any) -> None:
        super().__init__(decoded, self.made, self.values)
        self.cls = cls
        self.fields = fields
        self._readers = [(field.name, field.part.read) for field in fields]

    def made(self, value: Any) -> Any:
        """A new message with what was decoded.

        Raises:
            Unfit: A value does not fit its field.
        """
        message = self.cls()
        self.fill(message, value)
        return message

    def put(self, message: Any, name: str, value: Any) -> None:
        self.fill(getattr(message, name), value)

    def fill(self, message: Any, value: Any) -> None:
        """Set the fields of a message to what was decoded; those left out keep what they have.

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
            except AssertionError as exc:  # with ROS_PYTHON_CHECK_FIELDS=1, ROS looks, too
                raise Unfit(str(exc), f".{name}") from None

    def values(self, message: Any) -> dict[str, Any]:
        """The fields of a message by name, as msgspec can encode them."""
        return {
            name: getattr(message, name) if read is None else read(getattr(message, name))
            for name, read in self._readers
        }


def _is_nil(value: Any) -> bool:
    # msgspec has no type for "anything as it is in the payload, or None".
    return isinstance(value, msgspec.Raw) and memoryview(value)[0] == _NIL


class TimePart(MessagePart):
    """A `Time` that may be a datetime as well, or a `Duration` that may be a timedelta."""

    def __init__(self, fields: MessagePart, also: Any, read: Convert) -> None:
        """`also` is the other type that is decoded, `read` makes it unless it is None."""
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
    """A `Time` as text (RFC 3339), which is decoded also where a datetime is expected."""
    seconds, nanoseconds = divmod(time.sec * _BILLION + time.nanosec, _BILLION)
    whole = _EPOCH + datetime.timedelta(seconds=seconds)
    return f"{whole:%Y-%m-%dT%H:%M:%S}.{nanoseconds:09}Z"


def _span(duration: Any) -> datetime.timedelta:
    # To the nearest microsecond, as msgspec does with a time.
    microseconds = (duration.nanosec + 500) // 1000
    return datetime.timedelta(seconds=duration.sec, microseconds=microseconds)


class Message(Kind):
    """A message: a struct with named fields."""

    words: tuple[str, ...] = ("object",)

    def __init__(self, cls: Any) -> None:
        """Look at a class that ROS has generated.

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
        """A struct with the fields, the defaults and the constants of the message."""
        message = self.cls()
        fields: list[tuple[str, Any, Any]] = []
        for name, kind in self.fields.items():
            read = kind.bind(Schema(None), name, []).read
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
        fields: list[Field] = []
        decoded: list[tuple[str, Any, Any]] = []
        for name, kind in self.fields.items():
            wanted = option.field(name)
            if wanted is None:
                problems.append(f"{path}.{name} ({kind.text}): the action has no such field")
                continue
            part = kind.bind(wanted, f"{path}.{name}", problems)
            fields.append(Field(name, part, wanted.nullable))
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


class Time(Message):
    """`builtin_interfaces/Time`."""

    # The schema of a datetime is often no other than that of a string.
    words = ("object", "string", "datetime")

    def match(self, option: Option, path: str, problems: list[str]) -> Part:
        part = super().match(option, path, problems)
        if not isinstance(part, MessagePart):
            return part
        return TimePart(part, _AWARE, _moment if option.word in self.words[1:] else None)


class Duration(Message):
    """`builtin_interfaces/Duration`."""

    words = ("object", "timedelta")

    def match(self, option: Option, path: str, problems: list[str]) -> Part:
        part = super().match(option, path, problems)
        if not isinstance(part, MessagePart):
            return part
        return TimePart(part, datetime.timedelta, _span if option.word in self.words[1:] else None)


def _constants(cls: Any) -> dict[str, Any]:
    metaclass = cast("type[object]", type(cls))
    # The metaclass has a property for each, and one for each default of a field.
    constants = {
        name: getattr(cls, name)
        for name, member in vars(metaclass).items()
        if isinstance(member, property) and not name.endswith("__DEFAULT")
    }
    # One `byte` is an int for users, as in a field.
    return {name: ord(one) if isinstance(one, bytes) else one for name, one in constants.items()}


def _left_out(part: Part, wanted: Schema) -> Any:
    """What is decoded for a field that a payload leaves out.

    A user's type may be one that leaves out what it has by default. So his default counts for
    more than ROS's, which is what None stands for here.
    """
    default = wanted.default
    if default is MISSING or (default is None and wanted.nullable):
        return None
    try:
        if isinstance(default, str) and any(option.word == "bytes" for option in wanted.options):
            default = base64.b64decode(default)
        decode = partial(msgspec.msgpack.Decoder(part.decoded).decode, _encode(default))
        value = decode()
        if part.make is not None:  # which looks closer
            part.make(value)
    except (msgspec.MsgspecError, ValueError, OverflowError, TypeError):
        return msgspec.NODEFAULT  # he can only receive such a message, or must fill the field in
    return msgspec.field(default_factory=decode)


@cache
def message_kind(cls: Any) -> Message:
    """The kind of a class that ROS has generated.

    Raises:
        TransportError: It has a field that ROS's own Python code cannot handle.
    """
    special = {"Time": Time, "Duration": Duration}
    if cls.__module__.startswith("builtin_interfaces."):
        return special.get(cls.__name__, Message)(cls)
    return Message(cls)


def _kind_of(slot: Any, where: str) -> Kind:
    """The kind of a field, from what ROS says of its type."""
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


def _many(element: Kind, size: int | None, bound: int | None) -> Many:
    if isinstance(element, Number):
        return Numbers(element, size, bound)
    if isinstance(element, Octet):
        return Octets(size, bound)
    return Many(element, size, bound)

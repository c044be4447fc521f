"""The types of ROS messages: their fields, msgspec structs like them, and interface files of them.

A message type is described once by the adapter of a middleware, and bound once to each type of a
user that is used with it. Interface files define the same fields, defaults and constants; their
comments, and the exact types of constants, are not known of ROS's generated classes.
"""

from __future__ import annotations

import base64
import datetime
import json
import re
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple, cast

import msgspec
from msgspec import Meta

from fibaction.interfaces.definitions import InterfaceError, MessageDefinition
from fibaction.interfaces.parser import parse_message
from fibaction.interfaces.ros_types import attribute
from fibaction_transports.ros2.convert.fields import ArrayKind, Convert, Kind, Part, Unfit
from fibaction_transports.ros2.convert.schemas import MISSING, Option, UserSchema

_NIL = 0xC0  # null in msgpack
_BILLION = 10**9
_EPOCH = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
_AWARE = Annotated[datetime.datetime, Meta(tz=True)]

_encode = msgspec.msgpack.Encoder().encode


class BoundField(NamedTuple):
    """A field of a message, bound to the type that the user's end expects."""

    name: str
    attribute: str
    """The name of the attribute that holds it: another one if `name` is a keyword of Python."""
    part: Part
    nullable: bool
    """True if null may stand for ROS's default of the field."""


class MessagePart(Part):
    """A message, with the types that the user's end expects in its fields."""

    def __init__(self, cls: Any, fields: list[BoundField], decoded: Any) -> None:
        super().__init__(decoded, self.made, self.values)
        self.cls = cls
        self.fields = fields
        self._readers = [(field.name, field.attribute, field.part.read) for field in fields]

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
        for name, held, part, nullable in self.fields:
            new = getattr(value, held)
            if new is None or (nullable and _is_nil(new)):
                continue
            try:
                part.put(message, held, new)
            except Unfit as exc:
                raise exc.under(f".{name}") from None
            except AssertionError as exc:  # with ROS_PYTHON_CHECK_FIELDS=1, ROS checks, too
                raise Unfit(str(exc), f".{name}") from None

    def values(self, message: Any) -> dict[str, Any]:
        """Return the fields of a message by name, as msgspec can encode them."""
        return {
            name: getattr(message, held) if read is None else read(getattr(message, held))
            for name, held, read in self._readers
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

    def __init__(
        self,
        text: str,
        cls: Callable[[], Any],
        fields: Mapping[str, Kind],
        default: type[msgspec.Struct],
    ) -> None:
        """Describe a type.

        Args:
            text: Its name, for example `geometry_msgs/Point`.
            cls: Makes a message with ROS's defaults.
            fields: Its fields, in order. The attribute of a message that holds a field has a `_`
                after the name if that is a keyword of Python.
            default: A struct with these fields, for users without a type of their own.
        """
        self.text = text
        self.noun = f"the struct {text}"
        self.cls = cls
        self.fields = fields
        self.default = default

    def match(self, option: Option, path: str, problems: list[str]) -> Part:
        fields: list[BoundField] = []
        decoded: list[tuple[str, Any, Any]] = []
        for name, kind in self.fields.items():
            wanted = option.field(name)
            if wanted is None:
                problems.append(f"{path}.{name} ({kind.text}): the action has no such field")
                continue
            part = kind.bind(wanted, f"{path}.{name}", problems)
            fields.append(BoundField(name, attribute(name), part, wanted.nullable))
            # A `Raw` may be null already: see `_is_nil`.
            nullable = wanted.nullable and part.decoded is not msgspec.Raw
            type_ = part.decoded | None if nullable else part.decoded
            decoded.append((attribute(name), type_, _left_out(part, wanted)))
        strange = [name for name in option.names if name not in self.fields]
        problems.extend(f"{path}.{name}: the ROS type has no such field" for name in strange)
        if problems:
            return Part(Any)
        struct = msgspec.defstruct(
            self.default.__name__,
            decoded,
            rename={field.attribute: field.name for field in fields},
            forbid_unknown_fields=True,
            kw_only=True,
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


_CONSTANT = re.compile(r"[A-Z][A-Z0-9_]*", re.ASCII)
_TYPES_OF_CONSTANTS = {"bool": "bool", "int": "int64", "float": "float64", "str": "string"}


def interface_texts(
    type_name: str, goal: MessageKind, feedback: MessageKind, result: MessageKind
) -> dict[str, str]:
    """Return the text of an `.action` file, and those of the `.msg` files that it nests, by the
    types that they define.
    """
    parts = (goal, result, feedback)
    nested: dict[str, str] = {}
    for part in parts:
        _add_nested(part, nested)
    return {type_name: "---\n".join(map(_text, parts)), **nested}


def _add_nested(message: MessageKind, found: dict[str, str]) -> None:
    for kind in message.fields.values():
        single = kind.element if isinstance(kind, ArrayKind) else kind
        if isinstance(single, MessageKind):
            package, _, name = single.text.partition("/")
            type_name = f"{package}/msg/{name}"
            if type_name not in found:
                found[type_name] = _text(single)
                _add_nested(single, found)


def _text(message: MessageKind) -> str:
    return "".join(f"{line}\n" for line in (*_constants(message), *_fields(message)))


def _constants(message: MessageKind) -> Iterator[str]:
    attributes = cast("Mapping[str, Any]", vars(message.default))
    for name, value in attributes.items():
        if _CONSTANT.fullmatch(name) and (
            kind := _TYPES_OF_CONSTANTS.get(value.__class__.__name__)
        ):
            line = f"{'uint64' if kind == 'int64' and value >= 2**63 else kind} {name}={value}"
            read = _read(line)
            if read is not None and [one.value for one in read.constants] == [value]:
                yield line


def _fields(message: MessageKind) -> Iterator[str]:
    values = message.default()
    for name, kind in message.fields.items():
        line = f"{kind.text} {name}"
        value = getattr(values, attribute(name))
        if not _is_zero(kind, value):
            plain = list(value) if isinstance(value, bytes) else value
            with_default = f"{line} {json.dumps(plain, ensure_ascii=False)}"
            # A text, for example, may have a `#`, which files cannot have.
            read = _read(with_default)
            if read is not None and [field.default for field in read.fields] == [value]:
                line = with_default
        yield line


def _is_zero(kind: Kind, value: Any) -> bool:
    """Return whether a field has the default that ROS gives it without one in the file."""
    if isinstance(kind, MessageKind):
        return True
    if isinstance(kind, ArrayKind):
        is_fixed = kind.size is not None
        return isinstance(kind.element, MessageKind) or not (any(value) if is_fixed else value)
    return not value


def _read(line: str) -> MessageDefinition | None:
    """Return what a line defines; None if it is not one of an interface file."""
    try:
        return parse_message(line, Path("Line.msg"))
    except InterfaceError:
        return None

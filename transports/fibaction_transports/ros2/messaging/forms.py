"""The conversion between the messages of a node and the values that its user gives and gets."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from typing import Any, Final

import msgspec

from fibaction.border.peer_text import excerpt
from fibaction.types.action import Codec
from fibaction.types.ros_classes import ros_type_of
from fibaction.words.errors import ProtocolError
from fibaction_transports.ros2.convert.conversion import RosCodec
from fibaction_transports.ros2.convert.message_types import MessageKind, MessagePart
from fibaction_transports.ros2.convert.schemas import UserSchema
from fibaction_transports.ros2.node.parts import EndInfo

_ANYTHING: Final[Any] = Codec(Any)


def type_name_of(given: str | type[Any]) -> str:
    """Return the name of a type of ROS, which is given by this name or by a class made from it.

    Raises:
        TypeError: It is something else.
    """
    is_class = isinstance(given, type)
    name = given if isinstance(given, str) else ros_type_of(given) if is_class else ""
    if not name:
        raise TypeError(
            f"{given!r} is not made from a type of ROS: give the type by its name, such as"
            " 'geometry_msgs/msg/Twist', or a class that `fibaction gen` has written"
        )
    return name


class MessageForm:
    """The form of the messages of one end: the middleware's own, or values of a user's class."""

    def __init__(self, kind: MessageKind, given: str | type[Any]) -> None:
        """Describe it. With a name, users get the messages of the middleware, whose attributes are
        the fields of ROS; with a class, values of that class.

        Raises:
            TypeError: The class does not have the fields of the type.
        """
        self._kind = kind
        self._codec: Codec[Any] | None = None
        schema = UserSchema(None)
        if not isinstance(given, str) and given is not kind.cls:
            self._codec = Codec(given)
            schema = UserSchema(self._codec.schema())
        problems: list[str] = []
        part = kind.bind(schema, kind.text, problems)
        if problems:
            raise TypeError(f"{given!r} does not have the fields of ROS: {'; '.join(problems)}")
        assert isinstance(part, MessagePart)
        self._ros = RosCodec(part)
        self._struct: type[msgspec.Struct] | None = None
        """The class of the messages, if it is a struct that checks what it is made of."""
        config = getattr(kind.cls, "__struct_config__", None)
        if self._codec is None and config is not None and config.forbid_unknown_fields:
            self._struct = kind.cls  # type: ignore[assignment]  # it makes messages, as any of these

    def other_types(self, ends: Iterable[EndInfo]) -> str:
        """Return the types of the ends that have another one, as a text; empty if there is none, or
        if one end has this type.
        """
        theirs = {end.type_name for end in ends} - {""}
        is_shared = self._kind.text in {one.replace("/msg/", "/") for one in theirs}
        return "" if is_shared else " and ".join(sorted(theirs))

    def to_ros(self, value: Any) -> Any:
        """Return a value of the user as a message. Fields that a dict leaves out have ROS's
        defaults.

        Raises:
            ValueError: It does not fit; the text names the field.
        """
        if self._codec is None and isinstance(value, self._kind.cls):  # type: ignore[arg-type]  # ROS's own are classes, too
            return value
        if self._struct is not None:
            # The usual values need no copy. What follows takes others, and tells what is wrong.
            with suppress(msgspec.ValidationError):
                return msgspec.convert(value, self._struct, builtin_types=[bytes])
        codec = _ANYTHING if self._codec is None or isinstance(value, dict) else self._codec
        try:
            return self._ros.to_ros(codec.encode(value))
        except (ProtocolError, msgspec.MsgspecError, TypeError, OverflowError) as exc:
            raise ValueError(f"not a {self._kind.text}: {excerpt(str(exc))}") from exc

    def from_ros(self, message: Any) -> Any:
        """Return a message as its user gets it."""
        if self._codec is None:
            return message
        return self._codec.decode(self._ros.from_ros(message))

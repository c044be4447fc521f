"""The types of fields of ROS 2 messages, as types of msgspec with ROS's limits; and messages of ROS
converted to values of such types, and back.

    from fibaction.ros_types import from_ros, to_ros

    pose = from_ros(message)  # a struct, made from the ROS type
    message = to_ros(pose)

Messages need not be converted to be sent: see "ROS messages" in the guide on types.
"""

from __future__ import annotations

from functools import lru_cache
from importlib import import_module
from typing import Any, TypeVar, overload

from fibaction.interfaces.ros_types import (
    PRIMITIVES,
    Byte,
    Char,
    Int8,
    Int16,
    Int32,
    Int64,
    UInt8,
    UInt16,
    UInt32,
    UInt64,
    array,
    attribute,
    default,
    limited,
    string,
    struct,
)
from fibaction.types.action import Codec
from fibaction.types.ros_classes import is_message, is_message_class, message_class, ros_type_of
from fibaction.types.ros_messages import encode

__all__ = [
    "PRIMITIVES",
    "Byte",
    "Char",
    "Int8",
    "Int16",
    "Int32",
    "Int64",
    "UInt8",
    "UInt16",
    "UInt32",
    "UInt64",
    "array",
    "attribute",
    "default",
    "from_ros",
    "limited",
    "string",
    "struct",
    "to_ros",
]

T = TypeVar("T")

_REMEMBERED = 256
"""Types whose codecs are kept."""


@overload
def from_ros(message: object) -> Any: ...
@overload
def from_ros(message: object, message_type: type[T]) -> T: ...
def from_ros(message: object, message_type: Any = None) -> Any:
    """Convert a ROS message to a value of a type with the same fields.

    Without a type, it is the struct that is made from the ROS type, as by `Action.from_ros`.

    Raises:
        TypeError: It is not a ROS message, or the type has other fields.
        ProtocolError: A value does not fit, for example a number beyond its limits.
    """
    if not is_message(message):
        raise TypeError(f"expected a ROS message, got `{type(message).__qualname__}`")
    kind: Any = type(message)
    wanted: Any = message_class(kind).struct if message_type is None else message_type
    codec = _codec(wanted)
    return codec.decode(codec.encode(message))


@overload
def to_ros(value: object) -> Any: ...
@overload
def to_ros(value: object, message_type: type[T]) -> T: ...
def to_ros(value: object, message_type: Any = None) -> Any:
    """Convert a value to a ROS message of a class with the same fields.

    Without a class, it is the one of the ROS type that the value's struct is made from.

    Raises:
        TypeError: The class is not one of ROS, or none is given and the value's type is not made
            from a ROS type.
        ModuleNotFoundError: The ROS package is not installed here.
        ProtocolError: The value does not fit the class; the text names the field.
    """
    if message_type is None:
        message_type = _class_for(value)
    if not is_message_class(message_type):
        raise TypeError(f"expected a class of ROS, got `{message_type!r}`")
    return message_class(message_type).decode(encode(value))


@lru_cache(_REMEMBERED)
def _codec(message_type: Any) -> Codec[Any]:
    return Codec(message_type)


def _class_for(value: object) -> Any:
    ros_type = ros_type_of(type(value))
    if not ros_type:
        raise TypeError(
            f"`{type(value).__qualname__}` is not made from a ROS type: give the class of ROS, as"
            " in to_ros(pose, PoseStamped)"
        )
    package, folder, name = ros_type.split("/")
    # The goal of an action is the class `Goal` in that of the action.
    found: Any = import_module(f"{package}.{folder}")
    for part in name.split("_"):
        found = getattr(found, part)
    return found

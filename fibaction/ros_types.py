"""The types of fields of ROS 2 messages, as types of msgspec with ROS's limits; and messages of ROS
converted to values of such types, and back.
"""

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
from fibaction.types.ros_conversion import from_ros, to_ros

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

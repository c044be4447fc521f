"""The messages that a node has in addition to those of its actions: parameters, the time, and its
log on the topic `/rosout`, where `ros2 topic echo /rosout`, rqt and Foxglove read it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final

from msgspec import Struct, field

from fibaction.interfaces.files import InterfaceMessage
from fibaction_transports.cdr.codec import CdrCodec
from fibaction_transports.cdr.standard_messages import MESSAGES, STRUCTS, TimeMessage, composed
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.without_ros.messages.message_type import MessageType


class ParameterValue(Struct):
    """An `rcl_interfaces/msg/ParameterValue`: the type says which of the values counts."""

    type: int = 0
    bool_value: bool = False
    integer_value: int = 0
    double_value: float = 0.0
    string_value: str = ""
    byte_array_value: bytes = b""
    bool_array_value: list[bool] = []
    integer_array_value: list[int] = []
    double_array_value: list[float] = []
    string_array_value: list[str] = []


class Parameter(Struct):
    """An `rcl_interfaces/msg/Parameter`."""

    name: str = ""
    value: ParameterValue = field(default_factory=ParameterValue)


class ParameterEvent(Struct):
    """An `rcl_interfaces/msg/ParameterEvent`: what has changed at a node."""

    stamp: TimeMessage = field(default_factory=TimeMessage)
    node: str = ""
    new_parameters: list[Parameter] = []
    changed_parameters: list[Parameter] = []
    deleted_parameters: list[Parameter] = []


class ClockMessage(Struct):
    """A `rosgraph_msgs/msg/Clock`: the time of a simulation."""

    clock: TimeMessage = field(default_factory=TimeMessage)


_PARTS: dict[str, InterfaceMessage] = dict(MESSAGES)
NODE_STRUCTS: dict[str, Any] = dict(STRUCTS)


def node_message(
    type_name: str,
    text: str,
    made: Callable[..., Any],
    codec: type[CdrCodec] = CdrCodec,
) -> MessageType:
    """Return the type of a message from its definition, in which messages are named without their
    packages.
    """
    definition = composed(type_name, text, _PARTS)
    _PARTS[type_name.rpartition("/")[2]] = definition
    NODE_STRUCTS[type_name] = made
    return MessageType(definition, codec(definition, NODE_STRUCTS), made)


node_message(
    "rcl_interfaces/msg/ParameterValue",
    "uint8 type\nbool bool_value\nint64 integer_value\nfloat64 double_value\nstring string_value\n"
    "byte[] byte_array_value\nbool[] bool_array_value\nint64[] integer_array_value\n"
    "float64[] double_array_value\nstring[] string_array_value",
    ParameterValue,
)
PARAMETER: Final = node_message(
    "rcl_interfaces/msg/Parameter", "string name\nParameterValue value", Parameter
)
PARAMETER_EVENT: Final = node_message(
    "rcl_interfaces/msg/ParameterEvent",
    "Time stamp\nstring node\nParameter[] new_parameters\nParameter[] changed_parameters\n"
    "Parameter[] deleted_parameters",
    ParameterEvent,
)
CLOCK: Final = node_message("rosgraph_msgs/msg/Clock", "Time clock", ClockMessage)


ROSOUT: Final = "/rosout"
ROSOUT_QOS: Final = EndQos(durability="transient_local", depth=1000, lifespan=10.0)
"""The QoS of ROS: a node that comes late reads the lines of the last ten seconds."""
_BILLION = 10**9


class LogMessage(Struct):
    """An `rcl_interfaces/msg/Log`."""

    stamp: TimeMessage = field(default_factory=TimeMessage)
    level: int = 0
    """The level, which has the number of the same level in `logging`."""
    name: str = ""
    msg: str = ""
    file: str = ""
    function: str = ""
    line: int = 0


LOG: Final = node_message(
    "rcl_interfaces/msg/Log",
    "Time stamp\nuint8 level\nstring name\nstring msg\nstring file\nstring function\nuint32 line",
    LogMessage,
)


class RosoutLog:
    """The log of one node, for other nodes."""

    def __init__(self, full_name: str, publish: Callable[[LogMessage], None]) -> None:
        self._logger = full_name.removeprefix("/").replace("/", ".")
        self._publish = publish

    def write(self, level: int, text: str) -> None:
        """Publish a line."""
        stamp = TimeMessage(*divmod(time.time_ns(), _BILLION))
        self._publish(LogMessage(stamp, level, self._logger, text))

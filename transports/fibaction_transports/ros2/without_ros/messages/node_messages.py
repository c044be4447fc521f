"""The messages that a node has in addition to those of its actions: parameters and their services,
the time, and its log on the topic `/rosout`, where `ros2 topic echo /rosout`, rqt and Foxglove read
it.
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
from fibaction_transports.ros2.without_ros.messages.message_type import MessageType, ServiceType


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


_PACKAGE = "rcl_interfaces"


class FloatingPointRange(Struct):
    """An `rcl_interfaces/msg/FloatingPointRange`."""

    from_value: float = 0.0
    to_value: float = 0.0
    step: float = 0.0


class IntegerRange(Struct):
    """An `rcl_interfaces/msg/IntegerRange`."""

    from_value: int = 0
    to_value: int = 0
    step: int = 0


class ParameterDescriptor(Struct):
    """An `rcl_interfaces/msg/ParameterDescriptor`."""

    name: str = ""
    type: int = 0
    description: str = ""
    additional_constraints: str = ""
    read_only: bool = False
    dynamic_typing: bool = False
    floating_point_range: list[FloatingPointRange] = []
    integer_range: list[IntegerRange] = []


class SetParametersResult(Struct):
    """An `rcl_interfaces/msg/SetParametersResult`."""

    successful: bool = False
    reason: str = ""


class ListParametersResult(Struct):
    """An `rcl_interfaces/msg/ListParametersResult`."""

    names: list[str] = []
    prefixes: list[str] = []


class NamesRequest(Struct):
    """A request for parameters by their names."""

    names: list[str] = []


class ValuesResponse(Struct):
    """The values of parameters."""

    values: list[ParameterValue] = []


class TypesResponse(Struct):
    """The types of parameters."""

    types: bytes = b""


class DescriptorsResponse(Struct):
    """The descriptions of parameters."""

    descriptors: list[ParameterDescriptor] = []


class ListRequest(Struct):
    """A request for the names of parameters."""

    prefixes: list[str] = []
    depth: int = 0


class ListResponse(Struct):
    """The names of parameters."""

    result: ListParametersResult = field(default_factory=ListParametersResult)


class SetRequest(Struct):
    """A request that sets parameters."""

    parameters: list[Parameter] = []


class SetResponse(Struct):
    """A result for each parameter that was set."""

    results: list[SetParametersResult] = []


class SetAtomicallyResponse(Struct):
    """One result for all parameters that were set."""

    result: SetParametersResult = field(default_factory=SetParametersResult)


for _name, _text, _made in (
    (
        "FloatingPointRange",
        "float64 from_value\nfloat64 to_value\nfloat64 step",
        FloatingPointRange,
    ),
    ("IntegerRange", "int64 from_value\nint64 to_value\nuint64 step", IntegerRange),
    (
        "ParameterDescriptor",
        (
            "string name\nuint8 type\nstring description\nstring additional_constraints\n"
            "bool read_only\nbool dynamic_typing\n"
            "FloatingPointRange[<=1] floating_point_range\nIntegerRange[<=1] integer_range"
        ),
        ParameterDescriptor,
    ),
    ("SetParametersResult", "bool successful\nstring reason", SetParametersResult),
    ("ListParametersResult", "string[] names\nstring[] prefixes", ListParametersResult),
):
    node_message(f"{_PACKAGE}/msg/{_name}", _text, _made)


def _service(
    name: str, request: tuple[str, type[Struct]], response: tuple[str, type[Struct]]
) -> ServiceType:
    full = f"{_PACKAGE}/srv/{name}"
    return ServiceType(
        node_message(f"{full}_Request", *request), node_message(f"{full}_Response", *response)
    )


_NAMES = ("string[] names", NamesRequest)
_SET = ("Parameter[] parameters", SetRequest)
GET_PARAMETERS: Final = _service(
    "GetParameters", _NAMES, ("ParameterValue[] values", ValuesResponse)
)
GET_PARAMETER_TYPES: Final = _service("GetParameterTypes", _NAMES, ("uint8[] types", TypesResponse))
DESCRIBE_PARAMETERS: Final = _service(
    "DescribeParameters", _NAMES, ("ParameterDescriptor[] descriptors", DescriptorsResponse)
)
LIST_PARAMETERS: Final = _service(
    "ListParameters",
    ("string[] prefixes\nuint64 depth", ListRequest),
    ("ListParametersResult result", ListResponse),
)
SET_PARAMETERS: Final = _service(
    "SetParameters", _SET, ("SetParametersResult[] results", SetResponse)
)
SET_PARAMETERS_ATOMICALLY: Final = _service(
    "SetParametersAtomically", _SET, ("SetParametersResult result", SetAtomicallyResponse)
)
PARAMETER_SERVICES: Final = (
    GET_PARAMETERS,
    GET_PARAMETER_TYPES,
    DESCRIBE_PARAMETERS,
    LIST_PARAMETERS,
    SET_PARAMETERS,
    SET_PARAMETERS_ATOMICALLY,
)

"""The services of a node's parameters: their messages."""

from __future__ import annotations

from typing import Final

from msgspec import Struct, field

from fibaction_transports.ros2.without_ros.messages.message_type import ServiceType
from fibaction_transports.ros2.without_ros.messages.node_messages import (
    Parameter,
    ParameterValue,
    node_message,
)

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

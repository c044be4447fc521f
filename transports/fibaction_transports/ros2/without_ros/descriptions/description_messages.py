"""The messages of `type_description_interfaces/srv/GetTypeDescription`."""

from __future__ import annotations

from typing import Any, Final

from msgspec import Struct, field

from fibaction.words.errors import ProtocolError
from fibaction_transports.cdr.codec import CdrCodec
from fibaction_transports.ros2.without_ros.messages.message_type import ServiceType
from fibaction_transports.ros2.without_ros.messages.node_messages import node_message

LARGEST_DESCRIPTION: Final = 2**20
"""Bytes of an answer; the description of an action has about 6,000 with its sources."""
_MESSAGES = "type_description_interfaces/msg"
_SERVICE = "type_description_interfaces/srv/GetTypeDescription"


class UnusableDescription(ValueError):
    """A description that does not define the type that was asked for."""


class FieldTypeDescription(Struct):
    """A `type_description_interfaces/msg/FieldType`."""

    type_id: int = 0
    capacity: int = 0
    string_capacity: int = 0
    nested_type_name: str = ""


class FieldDescription(Struct):
    """A `type_description_interfaces/msg/Field`."""

    name: str = ""
    type: FieldTypeDescription = field(default_factory=FieldTypeDescription)
    default_value: str = ""


class IndividualTypeDescription(Struct):
    """A `type_description_interfaces/msg/IndividualTypeDescription`: one type."""

    type_name: str = ""
    fields: list[FieldDescription] = []


class TypeDescription(Struct):
    """A `type_description_interfaces/msg/TypeDescription`: a type, and those that it nests."""

    type_description: IndividualTypeDescription = field(default_factory=IndividualTypeDescription)
    referenced_type_descriptions: list[IndividualTypeDescription] = []


class TypeSource(Struct):
    """A `type_description_interfaces/msg/TypeSource`: the text that defines a type."""

    type_name: str = ""
    encoding: str = ""
    raw_file_contents: str = ""


class KeyValue(Struct):
    """A `type_description_interfaces/msg/KeyValue`."""

    key: str = ""
    value: str = ""


class DescriptionRequest(Struct):
    """A request for the description of a type that the node uses."""

    type_name: str = ""
    type_hash: str = ""
    include_type_sources: bool = True


class DescriptionResponse(Struct):
    """The description of a type, or the reason why there is none."""

    successful: bool = False
    failure_reason: str = ""
    type_description: TypeDescription = field(default_factory=TypeDescription)
    type_sources: list[TypeSource] = []
    extra_information: list[KeyValue] = []


for _name, _text, _made in (
    (
        "FieldType",
        "uint8 type_id\nuint64 capacity\nuint64 string_capacity\nstring<=255 nested_type_name",
        FieldTypeDescription,
    ),
    ("Field", "string name\nFieldType type\nstring default_value", FieldDescription),
    (
        "IndividualTypeDescription",
        "string<=255 type_name\nField[] fields",
        IndividualTypeDescription,
    ),
    (
        "TypeDescription",
        (
            "IndividualTypeDescription type_description\n"
            "IndividualTypeDescription[] referenced_type_descriptions"
        ),
        TypeDescription,
    ),
    (
        "TypeSource",
        "string type_name\nstring encoding\nstring raw_file_contents",
        TypeSource,
    ),
    ("KeyValue", "string key\nstring value", KeyValue),
):
    node_message(f"{_MESSAGES}/{_name}", _text, _made)


class _DescriptionCodec(CdrCodec):
    """The codec of the answers, which may be too large."""

    def decode(self, payload: bytes | bytearray | memoryview) -> Any:
        if len(payload) > LARGEST_DESCRIPTION:
            raise ProtocolError(f"a description of {len(payload):,} bytes is too large")
        return super().decode(payload)


GET_TYPE_DESCRIPTION: Final = ServiceType(
    node_message(
        f"{_SERVICE}_Request",
        "string type_name\nstring type_hash\nbool include_type_sources true",
        DescriptionRequest,
    ),
    node_message(
        f"{_SERVICE}_Response",
        "bool successful\nstring failure_reason\nTypeDescription type_description\n"
        "TypeSource[] type_sources\nKeyValue[] extra_information",
        DescriptionResponse,
        _DescriptionCodec,
    ),
)

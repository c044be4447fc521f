"""The descriptions of types by `type_description_interfaces`, and interface files made of them.

A description comes from a peer. It becomes text, which the parser of interface files checks as any
file, and it counts only if its hash is the one that the endpoints of the peer announce. So an
answer can be wrong only where the announcement is.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from msgspec import Struct, field

from fibaction.interfaces import ActionFile, InterfaceError
from fibaction.interfaces.files import (
    InterfaceMessage,
    read_action_texts,
    read_message_texts,
)
from fibaction.interfaces.parser import parse_message
from fibaction.words.errors import ProtocolError
from fibaction_transports.cdr.codec import CdrCodec
from fibaction_transports.cdr.standard_messages import action_interface
from fibaction_transports.cdr.type_hashes import NO_FIELDS, TYPE_NUMBERS, type_hash
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


for _name, _fields, _made in (
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
    node_message(f"{_MESSAGES}/{_name}", _fields, _made)


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


MOST_VALUES = 100_000
"""Values in a message with its defaults: the elements of arrays of a fixed size make them many."""

_BASES = {number: name for name, number in TYPE_NUMBERS.items() if name != "char"} | {
    21: "string<=",
    22: "wstring<=",
}
_NESTED = 1
_ARRAYS = ((144, "[]"), (96, "[<={}]"), (48, "[{}]"))
_PARTS = ("Goal", "Result", "Feedback")
_ANOTHER = "it has another hash"


def described_action(
    response: DescriptionResponse, type_name: str, *, feedback: str = "", action: str = ""
) -> ActionFile:
    """Return an action as another node describes it.

    With the hash of an `action`, the response describes all of it. With the hash of its `feedback`,
    it describes the messages that carry the feedback, and goal and result are empty.

    Raises:
        UnusableDescription: It is not that type, or has another hash, or is too large.
    """
    problem = _ANOTHER
    for texts in _variants(response, _texts(_individual(response), type_name)):
        try:
            file = _action_in(texts, type_name)
        except UnusableDescription as exc:
            problem = str(exc)
            continue
        if _hash(file, is_whole=bool(action)) == (action or feedback):
            return file
    raise UnusableDescription(problem)


def described_message(
    response: DescriptionResponse, type_name: str, wanted: str
) -> InterfaceMessage:
    """Return a message as another node describes it, whose type has the hash that is wanted.

    Raises:
        UnusableDescription: It is not that type, or has another hash, or is too large.
    """
    problem = _ANOTHER
    for texts in _variants(response, _messages(_individual(response))):
        try:
            message = read_message_texts(type_name, texts)
        except InterfaceError as exc:
            problem = str(exc)
            continue
        if type_hash(message) == wanted:
            if _values(message) > MOST_VALUES:
                raise UnusableDescription(f"it has more than {MOST_VALUES:,} values")
            return message
    raise UnusableDescription(problem)


def _individual(response: DescriptionResponse) -> dict[str, IndividualTypeDescription]:
    if not response.successful:
        raise UnusableDescription(response.failure_reason)
    described = response.type_description
    parts = (described.type_description, *described.referenced_type_descriptions)
    return {one.type_name: one for one in parts}


def _variants(
    response: DescriptionResponse, made: Mapping[str, str]
) -> tuple[Mapping[str, str], Mapping[str, str]]:
    """Return the texts of a response, first those of its sources, which have defaults and comments,
    too.
    """
    sources = {
        one.type_name: one.raw_file_contents
        for one in response.type_sources
        if one.type_name in made and one.encoding in ("msg", "action")
    }
    return {**made, **sources}, made


def looked_up_action(
    individual: Mapping[str, IndividualTypeDescription], type_name: str
) -> ActionFile:
    """Return an action as the types of its messages define it; the hashes are not checked.

    Raises:
        UnusableDescription: They do not define an action, or it is too large.
    """
    return _action_in(_texts(individual, type_name), type_name)


def _action_in(texts: Mapping[str, str], type_name: str) -> ActionFile:
    try:
        file = read_action_texts(type_name, texts)
    except InterfaceError as exc:
        raise UnusableDescription(str(exc)) from exc
    if _values(file.goal, file.result, file.feedback) > MOST_VALUES:
        raise UnusableDescription(f"it has more than {MOST_VALUES:,} values")
    return file


def _hash(file: ActionFile, *, is_whole: bool) -> str:
    interface = action_interface(file)
    return type_hash(interface if is_whole else interface.nested["feedback_message"])


def _values(*messages: InterfaceMessage) -> int:
    """Return the number of values of messages with their defaults."""
    counted: dict[str, int] = {}

    def count(message: InterfaceMessage) -> int:
        if message.type_name not in counted:
            total = 1
            for field in message.definition.fields:
                nested = message.nested.get(field.name)
                times = (field.type.size or 0) if field.type.is_array else 1
                total += times * (1 if nested is None else count(nested))
            counted[message.type_name] = total
        return counted[message.type_name]

    return sum(map(count, messages))


def _texts(individual: Mapping[str, IndividualTypeDescription], type_name: str) -> dict[str, str]:
    """Return the texts of files, by the types that they define."""
    parts = [individual.get(f"{type_name}_{part}") for part in _PARTS]
    action = "---\n".join("" if part is None else _text(part) for part in parts)
    return {**_messages(individual), type_name: action}


def _messages(individual: Mapping[str, IndividualTypeDescription]) -> dict[str, str]:
    return {name: _text(one) for name, one in individual.items() if name.split("/")[1:2] == ["msg"]}


def _text(one: IndividualTypeDescription) -> str:
    if [field.name for field in one.fields] == [NO_FIELDS[0]]:
        return ""
    return "".join(f"{_line(field)}\n" for field in one.fields)


def _line(field: FieldDescription) -> str:
    line = f"{_type(field.type)} {field.name}"
    with_default = f"{line} {field.default_value}"
    if field.default_value and _is_valid(with_default):
        return with_default
    return line


def _is_valid(line: str) -> bool:
    try:
        return len(parse_message(line, Path("Default.msg")).fields) == 1
    except InterfaceError:
        return False


def _type(described: FieldTypeDescription) -> str:
    number = described.type_id
    length, form = next(((low, form) for low, form in _ARRAYS if number > low), (0, ""))
    base = _BASES.get(number - length, "")
    if number - length == _NESTED:
        package, _, name = described.nested_type_name.partition("/msg/")
        base = f"{package}/{name}"
    elif base.endswith("<="):
        base += str(described.string_capacity)
    if not base:
        raise UnusableDescription(f"it has a field of the type {number}, which files cannot have")
    return base + form.format(described.capacity)

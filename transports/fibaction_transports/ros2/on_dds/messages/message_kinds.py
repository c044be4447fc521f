"""The kinds of fields of the messages that are made from interface files."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from fibaction.interfaces.definitions import FieldType
from fibaction.interfaces.files import InterfaceMessage
from fibaction_transports.ros2.convert.fields import SINGLES, Kind, array_kind, text_kind
from fibaction_transports.ros2.convert.message_types import DurationKind, MessageKind, TimeKind

_CHAR = "uint8"
"""The type that ROS 2 has for a `char`."""
_TEXTS = {"string": False, "wstring": True}
_TIMES = {
    "builtin_interfaces/msg/Time": TimeKind,
    "builtin_interfaces/msg/Duration": DurationKind,
}


def message_kind(
    message: InterfaceMessage, structs: Mapping[str, type[msgspec.Struct]]
) -> MessageKind:
    """Return the kind of a message whose structs are those of `make_structs`."""
    fields: dict[str, Kind] = {}
    for field in message.definition.fields:
        nested, kind = message.nested.get(field.name), field.type
        single = _single_kind(kind) if nested is None else message_kind(nested, structs)
        is_array = kind.is_array
        fields[field.name] = array_kind(single, kind.size, kind.bound) if is_array else single
    cls = structs[message.class_name]
    name = f"{message.package}/{message.definition.name}"
    return _TIMES.get(message.type_name, MessageKind)(name, cls, fields, cls)


def _single_kind(kind: FieldType) -> Kind:
    if kind.base in _TEXTS:
        return text_kind(_TEXTS[kind.base], kind.characters)
    return SINGLES.get(kind.base, SINGLES[_CHAR])

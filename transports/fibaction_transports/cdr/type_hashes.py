"""Type hashes of ROS (RIHS01): SHA-256 of the description of a type, in one exact form of JSON.

Two ends with equal hashes have the same definition. The hash covers the names and types of the
fields, and the same of all messages that are nested; constants, defaults and comments are left out.
https://github.com/ros-infrastructure/rep/pull/381 proposes the standard, REP 2011.
"""

from __future__ import annotations

import json
from hashlib import sha256
from typing import Any, Final, TypeAlias

from fibaction.interfaces.definitions import FieldType
from fibaction.interfaces.files import InterfaceMessage

PREFIX: Final = "RIHS01_"

Description: TypeAlias = dict[str, Any]

_MESSAGE = 1
# `char` is a uint8 in ROS 2, and the type named CHAR (13) is not used by interface files.
TYPE_NUMBERS: Final[dict[str, int]] = {
    "int8": 2,
    "uint8": 3,
    "char": 3,
    "int16": 4,
    "uint16": 5,
    "int32": 6,
    "uint32": 7,
    "int64": 8,
    "uint64": 9,
    "float32": 10,
    "float64": 11,
    "bool": 15,
    "byte": 16,
    "string": 17,
    "wstring": 18,
}
"""The numbers of types in `type_description_interfaces/msg/FieldType`."""
_BOUNDED_TEXT = 4
_ARRAY, _BOUNDED, _UNBOUNDED = 48, 96, 144
"""The offsets that make the number of a type that of an array of it."""

NO_FIELDS: Final = ("structure_needs_at_least_one_member", FieldType("uint8"))
"""The member that ROS puts into a message without fields."""


def type_hash(message: InterfaceMessage) -> str:
    """Return the hash of a type, for example `RIHS01_20b6...`.

    Raises:
        ValueError: The type, or one that it nests, has no full name.
    """
    text = json.dumps(type_description(message))
    return PREFIX + sha256(text.encode()).hexdigest()


def type_description(message: InterfaceMessage) -> Description:
    """Return the description that is hashed: of the type, and of all that it nests, by name.

    It is a `type_description_interfaces/msg/TypeDescription` without the defaults of fields.

    Raises:
        ValueError: The type, or one that it nests, has no full name.
    """
    nested: dict[str, Description] = {}
    _add_nested(message, nested)
    return {
        "type_description": _individual(message),
        "referenced_type_descriptions": [nested[name] for name in sorted(nested)],
    }


def _add_nested(message: InterfaceMessage, found: dict[str, Description]) -> None:
    for one in message.nested.values():
        if one.type_name not in found:
            found[one.type_name] = _individual(one)
            _add_nested(one, found)


def _individual(message: InterfaceMessage) -> Description:
    if not message.type_name:
        raise ValueError(
            f"{message.full_name} has no type hash, because its package is unknown: put its file"
            " into package/msg/ or package/action/"
        )
    fields = [(field.name, field.type) for field in message.definition.fields] or [NO_FIELDS]
    return {
        "type_name": message.type_name,
        "fields": [
            {"name": name, "type": _field_type(kind, message.nested.get(name))}
            for name, kind in fields
        ],
    }


def _field_type(kind: FieldType, nested: InterfaceMessage | None) -> Description:
    number = _MESSAGE if nested is not None else TYPE_NUMBERS[kind.base]
    if kind.characters is not None:
        number += _BOUNDED_TEXT
    if kind.size is not None:
        number += _ARRAY
    elif kind.bound is not None:
        number += _BOUNDED
    elif kind.is_array:
        number += _UNBOUNDED
    return {
        "type_id": number,
        "capacity": kind.size or kind.bound or 0,
        "string_capacity": kind.characters or 0,
        "nested_type_name": nested.type_name if nested is not None else "",
    }

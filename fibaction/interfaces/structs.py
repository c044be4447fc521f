"""Structs of msgspec for the messages of an action.

`fibaction.interfaces.source` writes the same types and uses the functions below, so that both
agree.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from fibaction.interfaces.definitions import FieldDefinition, FieldType
from fibaction.interfaces.files import ActionFile, InterfaceMessage
from fibaction.interfaces.ros_types import PRIMITIVES, UInt8, array, string, struct


def make_structs(action: ActionFile) -> dict[str, type[msgspec.Struct]]:
    """Return a struct for each message, and for those that it nests, by class name."""
    return structs_of(action.messages())


def structs_of(messages: Iterable[InterfaceMessage]) -> dict[str, type[msgspec.Struct]]:
    """Return a struct for each message, by class name. Each comes after those that it nests."""
    made: dict[str, type[msgspec.Struct]] = {}
    for message in messages:
        made[message.class_name] = _struct(message, made)
    return made


def is_bytes(kind: FieldType) -> bool:
    """Return whether values of the type are `bytes` in Python."""
    return kind.is_array and not kind.is_message and PRIMITIVES[kind.base] == UInt8


def plain_default(field: FieldDefinition) -> Any:
    """Return a field's default as plain data; without one in the file, that of ROS.

    Nested messages are dicts.
    """
    if field.default is not None:
        return field.default
    if is_bytes(field.type):
        return bytes(field.type.size or 0)
    single: Any = {} if field.type.is_message else _zero(field.type.base)
    return [single] * (field.type.size or 0) if field.type.is_array else single


def docstring(message: InterfaceMessage) -> str:
    """Return the docstring of a message's class: the comment on top of the file, or the name."""
    text = message.definition.comment
    if "\n " in text:  # on the line of the quotes, readers would take the indent for the source's
        text = f"\n{text}"
    return text or f"{message.full_name[0].upper()}{message.full_name[1:]}."


def _struct(
    message: InterfaceMessage, made: Mapping[str, type[msgspec.Struct]]
) -> type[msgspec.Struct]:
    definition = message.definition
    fields: list[tuple[str, Any, Any]] = []
    for field in definition.fields:
        nested = message.nested.get(field.name)
        kind = _type_of(field.type, made[nested.class_name] if nested else None)
        if field.comment:
            kind = Annotated[kind, Meta(description=field.comment)]
        fields.append((field.name, kind, plain_default(field)))
    return struct(
        message.class_name,
        fields,
        module=message.package or __name__,
        doc=docstring(message),
        constants={constant.name: constant.value for constant in definition.constants},
        ros_type=message.type_name,
    )


def _type_of(kind: FieldType, nested: Any) -> Any:
    single = nested or PRIMITIVES[kind.base]
    if kind.characters is not None:
        single = string(kind.characters)
    return array(single, size=kind.size, bound=kind.bound) if kind.is_array else single


def _zero(base: str) -> Any:
    kind = PRIMITIVES[base]
    return kind() if isinstance(kind, type) else 0

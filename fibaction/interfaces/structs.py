"""Structs of msgspec for the messages of an action.

What their fields are is also what `fibaction.interfaces.source` writes, so that both agree.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from fibaction.interfaces.definitions import Field, FieldType
from fibaction.interfaces.files import ActionFile, Message
from fibaction.ros_types import PRIMITIVES, UInt8, array, string, struct

_WIDTH = 78
"""To how many columns a longer line of a comment is broken in the docstring of a class."""


def make_structs(action: ActionFile) -> dict[str, type[msgspec.Struct]]:
    """The struct of each message, by its name, and of those that it nests."""
    made: dict[str, type[msgspec.Struct]] = {}
    for message in action.messages():
        made[message.class_name] = _struct(message, made)
    return made


def _struct(message: Message, made: Mapping[str, type[msgspec.Struct]]) -> type[msgspec.Struct]:
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
    )


def _type_of(kind: FieldType, nested: Any) -> Any:
    single = nested or PRIMITIVES[kind.base]
    if kind.characters is not None:
        single = string(kind.characters)
    return array(single, size=kind.size, bound=kind.bound) if kind.is_array else single


def is_bytes(kind: FieldType) -> bool:
    """Whether it is an array that is `bytes` in Python."""
    return kind.is_array and not kind.is_message and PRIMITIVES[kind.base] == UInt8


def plain_default(field: Field) -> Any:
    """What a field has unless told otherwise, as ROS has it; nested messages are dicts."""
    if field.default is not None:
        return field.default
    if is_bytes(field.type):
        return bytes(field.type.size or 0)
    single: Any = {} if field.type.is_message else zero(field.type.base)
    return [single] * (field.type.size or 0) if field.type.is_array else single


def zero(base: str) -> Any:
    """What ROS has in a field of a primitive type that has no default."""
    kind = PRIMITIVES[base]
    return kind() if isinstance(kind, type) else 0


def docstring(message: Message) -> str:
    """The docstring of the class: the comment on top of the message, or what it is."""
    comment = message.definition.comment
    if not comment:
        return f"{message.full_name[0].upper()}{message.full_name[1:]}."
    lines = [
        textwrap.wrap(line, _WIDTH, break_long_words=False, break_on_hyphens=False) or [""]
        if len(line) > _WIDTH
        else [line]
        for line in comment.splitlines()
    ]
    return "\n".join(line.rstrip() for part in lines for line in part)

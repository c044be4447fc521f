"""Interface files made of types that are known by other means, such as ROS's generated classes.

They define the same fields, defaults and constants. Comments, and the exact types of constants, are
not known.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

from fibaction.interfaces.definitions import InterfaceError, MessageDefinition
from fibaction.interfaces.parser import parse_message
from fibaction.interfaces.ros_types import attribute
from fibaction_transports.ros2.convert.fields import ArrayKind, Kind
from fibaction_transports.ros2.convert.message_types import MessageKind

_CONSTANT = re.compile(r"[A-Z][A-Z0-9_]*", re.ASCII)
_TYPES_OF_CONSTANTS = {"bool": "bool", "int": "int64", "float": "float64", "str": "string"}


def interface_texts(
    type_name: str, goal: MessageKind, feedback: MessageKind, result: MessageKind
) -> dict[str, str]:
    """Return the text of an `.action` file, and those of the `.msg` files that it nests, by the
    types that they define.
    """
    parts = (goal, result, feedback)
    nested: dict[str, str] = {}
    for part in parts:
        _add_nested(part, nested)
    return {type_name: "---\n".join(map(_text, parts)), **nested}


def _add_nested(message: MessageKind, found: dict[str, str]) -> None:
    for kind in message.fields.values():
        single = kind.element if isinstance(kind, ArrayKind) else kind
        if isinstance(single, MessageKind):
            package, _, name = single.text.partition("/")
            type_name = f"{package}/msg/{name}"
            if type_name not in found:
                found[type_name] = _text(single)
                _add_nested(single, found)


def _text(message: MessageKind) -> str:
    return "".join(f"{line}\n" for line in (*_constants(message), *_fields(message)))


def _constants(message: MessageKind) -> Iterator[str]:
    attributes = cast("Mapping[str, Any]", vars(message.default))
    for name, value in attributes.items():
        if _CONSTANT.fullmatch(name) and (
            kind := _TYPES_OF_CONSTANTS.get(value.__class__.__name__)
        ):
            line = f"{'uint64' if kind == 'int64' and value >= 2**63 else kind} {name}={value}"
            read = _read(line)
            if read is not None and [one.value for one in read.constants] == [value]:
                yield line


def _fields(message: MessageKind) -> Iterator[str]:
    values = message.default()
    for name, kind in message.fields.items():
        line = f"{kind.text} {name}"
        value = getattr(values, attribute(name))
        if not _is_zero(kind, value):
            plain = list(value) if isinstance(value, bytes) else value
            with_default = f"{line} {json.dumps(plain, ensure_ascii=False)}"
            # A text, for example, may have a `#`, which files cannot have.
            read = _read(with_default)
            if read is not None and [field.default for field in read.fields] == [value]:
                line = with_default
        yield line


def _is_zero(kind: Kind, value: Any) -> bool:
    """Return whether a field has the default that ROS gives it without one in the file."""
    if isinstance(kind, MessageKind):
        return True
    if isinstance(kind, ArrayKind):
        is_fixed = kind.size is not None
        return isinstance(kind.element, MessageKind) or not (any(value) if is_fixed else value)
    return not value


def _read(line: str) -> MessageDefinition | None:
    """Return what a line defines; None if it is not one of an interface file."""
    try:
        return parse_message(line, Path("Line.msg"))
    except InterfaceError:
        return None

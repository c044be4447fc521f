"""Type definitions as rosapi tells them, from the JSON Schemas of an action, and the way back.

The schemas have the form of those that are made from ROS's own classes: see
`fibaction.interfaces.ros_types`. rosapi tells less than the classes: no bounds of strings and
arrays, and no defaults of arrays. A field whose type it does not describe may have any value.

Servers differ. Old ones put `_` before the names of fields, and some say `sequence<double, 3>`, or
the name of a class of Python, where they do not understand an array.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import Any

import msgspec

from fibaction.interfaces import ros_types
from fibaction.schema.check import JsonSchema
from fibaction.schema.payload import MAX_PARTS
from fibaction.words.plain_data import is_map
from fibaction_transports.web.rosbridge.action_values import DATA, target_of

NOT_AN_ARRAY = -1
ANY_LENGTH = 0

_INTEGERS: Mapping[tuple[Any, Any], str] = {
    (-(2**7), 2**7 - 1): "int8",
    (-(2**15), 2**15 - 1): "int16",
    (-(2**31), 2**31 - 1): "int32",
    (0, 2**8 - 1): "uint8",
    (0, 2**16 - 1): "uint16",
    (0, 2**32 - 1): "uint32",
    (0, None): "uint64",
}
"""The types of integers, by their limits; all others are `int64`."""
_EXAMPLES = {"boolean": "False", "float64": "0.0", "string": ""}
_SCALARS = frozenset({"integer", "number", "boolean", "string"})
"""The kinds of values that are no parts of a message of their own."""
MOST_ITEMS = 2**31 - 1
"""Items of the longest array; a length above is a mistake."""
_PRIMITIVES: Mapping[str, dict[str, Any]] = {
    name: msgspec.json.schema(kind)
    for name, kind in {
        **ros_types.PRIMITIVES,
        # The names of IDL.
        "boolean": bool,
        "octet": ros_types.Byte,
        "float": float,
        "double": float,
    }.items()
}
_OCTET = msgspec.json.schema(ros_types.UInt8)
_ARRAY = re.compile(r"(?:sequence<)?(.*?)(?:, (\d{1,9}))?>?", re.DOTALL)
_BOUNDED_STRING = re.compile(r"w?string<=?(\d{1,9})>?")
_ESCAPES = {"\\t": 9, "\\n": 10, "\\r": 13, "\\'": 39, "\\\\": 92}
_READERS: Mapping[str, Callable[[str], Any]] = {
    "boolean": {"True": True, "False": False}.__getitem__,
    "integer": int,
    "number": float,
    "string": str,
}


class TypeDefinition(msgspec.Struct):
    """A `rosapi_msgs/msg/TypeDef`."""

    type: str
    fieldnames: list[str] = []
    fieldtypes: list[str] = []
    fieldarraylen: list[int] = []
    examples: list[str] = []
    constnames: list[str] = []
    constvalues: list[str] = []
    required: list[str] | msgspec.UnsetType = msgspec.UNSET
    """The fields without defaults, which ROS does not have: only servers of fibaction tell them."""


def definitions(schema: dict[str, Any], name: str) -> list[TypeDefinition]:
    """Return the definition of a message, which has that name, and those of its parts; none if the
    message may be any object.

    Raises:
        SchemaError: The schema cannot be used.
    """
    known = JsonSchema(schema)
    found: dict[str, TypeDefinition] = {}
    waiting: list[tuple[str, Any]] = [(name, _message(target_of(known, schema)))]
    while waiting:
        name, part = waiting.pop(0)
        part = target_of(known, part)
        if name in found or not is_map(part):
            continue
        definition = found[name] = TypeDefinition(name)
        if part.get("required"):
            definition.required = list(part["required"])
        for field, of_field in part.get("properties", {}).items():
            kind, length, nested = _described(known, of_field, f"{name}/{field}")
            definition.fieldnames.append(field)
            definition.fieldtypes.append(kind)
            definition.fieldarraylen.append(length)
            default = of_field.get("default") if is_map(of_field) else None
            definition.examples.append(
                _example(kind, length, default, is_nested=nested is not None)
            )
            if nested is not None:
                waiting.append((kind, nested))
    return list(found.values())


def _message(root: Any) -> Any:
    """Return the schema of a message, which has a field `data` if `root` is that of a value.

    It is None for an unknown message.
    """
    if is_map(root) and (root.get("type") == "array" or root.get("type") in _SCALARS):
        return {"properties": {DATA: root}, "required": [DATA]}
    return root if is_map(root) and "properties" in root else None


def _described(schema: JsonSchema, part: Any, name: str) -> tuple[str, int, Any]:
    """Return the type of a field, the length of its array, and the schema of what it nests."""
    while is_map(part) and "$ref" in part:
        name = part["$ref"].rpartition("/")[2]
        part = schema.target(part["$ref"])
    if not is_map(part):
        return "any", NOT_AN_ARRAY, None
    kind = part.get("type")
    if kind == "integer":
        limits = part.get("minimum"), part.get("maximum")
        return _INTEGERS.get(limits, "int64"), NOT_AN_ARRAY, None
    if kind in ("number", "boolean"):
        return "float64" if kind == "number" else kind, NOT_AN_ARRAY, None
    if kind == "string":
        is_bytes = part.get("contentEncoding") == "base64"
        return ("uint8", ANY_LENGTH, None) if is_bytes else ("string", NOT_AN_ARRAY, None)
    if kind == "array":
        inner, _, nested = _described(schema, part.get("items", {}), name)
        length: Any = part.get("maxItems")
        is_fixed = length == part.get("minItems") and isinstance(length, int)
        return inner, length if is_fixed else ANY_LENGTH, nested
    if "properties" in part:
        return name, NOT_AN_ARRAY, part
    return "any", NOT_AN_ARRAY, None


def _example(kind: str, length: int, default: object, *, is_nested: bool) -> str:
    """Return the default of a field as text, as rosapi does; the empty value if it has none."""
    if length != NOT_AN_ARRAY:
        return "[]"
    if is_nested:
        return "{}"
    if kind != "any" and isinstance(default, (bool, int, float, str)):
        return str(default)
    return _EXAMPLES.get(kind, "0")


def schema_of(definitions: Iterable[TypeDefinition]) -> dict[str, Any]:
    """Return the JSON Schema of a message; empty if there is no definition, or if the schema would
    be too large to be used.

    `definitions` are that of the message, and those of its parts.
    """
    known = {one.type: one for one in definitions}
    if not known or sum(1 + len(one.fieldnames) for one in known.values()) > MAX_PARTS:
        return {}
    names = _short_names(known)
    first, *_ = names.values()
    return {
        "$ref": f"#/$defs/{first}",
        "$defs": {names[one.type]: _struct(one, names) for one in known.values()},
    }


def _short_names(types: Iterable[str]) -> dict[str, str]:
    """Return the names of types in the schema: without their packages, where that is enough."""
    found: dict[str, str] = {}
    taken: set[str] = set()
    for name in types:
        short = _without_package(name)
        found[name] = name.replace("/", ".") if short in taken else short
        taken.add(found[name])
    return found


def _without_package(name: str) -> str:
    return name.rpartition("/")[2]


def _struct(definition: TypeDefinition, names: Mapping[str, str]) -> dict[str, Any]:
    rows = zip(
        definition.fieldnames,
        definition.fieldtypes,
        definition.fieldarraylen,
        definition.examples,
        strict=False,
    )
    required = set[str]() if definition.required is msgspec.UNSET else set(definition.required)
    is_of_ros = "/" in definition.type
    return {
        "title": _without_package(definition.type),
        **({"description": f"`{definition.type}` of ROS 2."} if is_of_ros else {}),
        "type": "object",
        "properties": {
            name.removeprefix("_"): _field(
                kind, length, None if name in required else example, names
            )
            for name, kind, length, example in rows
        },
        "required": [name for name in definition.fieldnames if name in required],
        "additionalProperties": False,
    }


def _field(kind: str, length: int, example: str | None, names: Mapping[str, str]) -> dict[str, Any]:
    if length == NOT_AN_ARRAY and kind.startswith("sequence<"):
        length = ANY_LENGTH
    if length == NOT_AN_ARRAY:
        element = _element(kind, names)
        return element | _default(element, example)
    match = _ARRAY.fullmatch(kind)
    assert match is not None  # it matches any text
    element = _element(match[1], names)
    if not element:
        return {}
    least = length if 0 < length <= MOST_ITEMS else None
    most = least if match[2] is None else int(match[2])
    return _array(element, least, most)


def _element(kind: str, names: Mapping[str, str]) -> dict[str, Any]:
    """Return the schema of a single value; empty if its type is not described."""
    if kind in names:
        return {"$ref": f"#/$defs/{names[kind]}"}
    if bounded := _BOUNDED_STRING.fullmatch(kind):
        return {"type": "string", "maxLength": int(bounded[1])}
    return _PRIMITIVES.get(kind, {})


def _array(element: dict[str, Any], least: int | None, most: int | None) -> dict[str, Any]:
    if element == _OCTET:
        schema: dict[str, Any] = {"type": "string", "contentEncoding": "base64"}
        limits = "minLength", "maxLength"
        least, most = (None if one is None else 4 * ((one + 2) // 3) for one in (least, most))
    else:
        schema = {"type": "array", "items": element}
        limits = "minItems", "maxItems"
    found = zip(limits, (least, most), strict=True)
    return schema | {name: limit for name, limit in found if limit is not None}


# Defaults: the examples of rosapi are the values of a new message.


def _octet(example: str) -> int:
    """Return a `byte`, which rosapi writes as Python does, for example `b'A'`."""
    if not example.startswith("b"):
        return int(example)
    text = example[2:-1]
    if text.startswith("\\x"):
        return int(text[2:], 16)
    return ord(text) if len(text) == 1 else _ESCAPES[text]


def _default(element: dict[str, Any], example: str | None) -> dict[str, Any]:
    """Return the default of a field as a part of its schema; empty if the field has none."""
    read = _octet if element == _OCTET else _READERS.get(element.get("type", ""))
    if read is None or example is None:
        return {}
    with suppress(LookupError, ValueError):
        value = read(example)
        if isinstance(value, str) or _least(element) <= value <= _most(element):  # NaN is not
            return {"default": value}
    return {}


def _least(element: dict[str, Any]) -> float:
    least: float = element.get("minimum", -sys.float_info.max)
    return least


def _most(element: dict[str, Any]) -> float:
    largest = 2**64 - 1 if element["type"] == "integer" else sys.float_info.max
    most: float = element.get("maximum", largest)
    return most

"""Type definitions as rosapi describes them, from the JSON Schemas of an action."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from fibaction.schema.json_schema import JsonSchema
from fibaction.words.plain_data import is_map
from fibaction_transports.web.rosbridge.types.action_values import DATA, target_of

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
            kind, length, nested = _field(known, of_field, f"{name}/{field}")
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


def _field(schema: JsonSchema, part: Any, name: str) -> tuple[str, int, Any]:
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
        inner, _, nested = _field(schema, part.get("items", {}), name)
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

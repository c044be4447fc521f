"""Templates: a value that a JSON Schema allows, to be filled in.

The schema comes from a server: nothing is fetched, and the work is limited.
"""

from __future__ import annotations

import math
from typing import Any

from fibaction.schema.check import JsonSchema, SchemaError
from fibaction.schema.keywords import is_multiple_of
from fibaction.words.plain_data import is_list, is_map, is_number

MAX_FIELDS = 500
"""Fields of a template."""
MAX_LEVELS = 10
"""Levels of fields within fields; a type may contain itself."""
MAX_LENGTH = 1000
"""Characters of a text in a template."""
MOST_MULTIPLES = 10
"""Multiples of a unit that are tried: 3 * 0.1 is none of 0.1 to a float, and 4 * 0.1 is one."""

_EMPTY: dict[str, Any] = {"integer": 0, "number": 0.0, "string": "", "boolean": False, "null": None}
FORMATS = {
    "date-time": "2026-01-31T12:00:00Z",
    "iso-date-time": "2026-01-31T12:00:00Z",
    "date-time-local": "2026-01-31T12:00:00",
    "date": "2026-01-31",
    "time": "12:00:00",
    "iso-time": "12:00:00",
    "partial-time": "12:00:00",
    "duration": "PT1S",
    "uuid": "00000000-0000-0000-0000-000000000000",
}
"""A text of each known format."""


class Template:
    """A value with all fields of a schema: the default of each, or the empty value of its type."""

    def __init__(self, schema: dict[str, Any]) -> None:
        """Make the template of a schema; of one that cannot be used, it is an empty map."""
        self._left = MAX_FIELDS
        self.fields: dict[str, Any] = {}
        """The schemas of the fields; empty if the value has none."""
        self.required: list[str] = []
        """The names of the fields that have to be given."""
        self.value: Any = {}
        """The template as plain data."""
        self.is_usable = False
        """True if the schema has a template."""
        try:
            self._schema = JsonSchema(schema)
            root = self.resolved(self._schema.root)
            self.value = self._value(root, 0)
        except SchemaError:
            return
        self.is_usable = True
        if is_map(self.value):
            self.fields, self.required = root.get("properties", {}), root.get("required", [])

    def resolved(self, part: Any) -> dict[Any, Any]:
        """Return the schema behind references and alternatives."""
        for _ in range(MAX_LEVELS):
            if not is_map(part):
                break
            alternatives = part.get("anyOf") or part.get("oneOf")
            if "$ref" in part:
                part = self._schema.target(part["$ref"])
            elif alternatives:
                named = (one for one in alternatives if one != {"type": "null"})
                part = next(named, alternatives[0])
            else:
                return part
        return {}

    def _value(self, part: Any, depth: int) -> Any:
        self._left -= 1
        if depth > MAX_LEVELS or self._left < 0:
            raise SchemaError("is too large for a template")
        if is_map(part) and "default" in part:
            return part["default"]
        part = self.resolved(part)
        for keyword in ("default", "const"):
            if keyword in part:
                return part[keyword]
        if part.get("enum"):
            return part["enum"][0]
        if "properties" in part:
            fields = part["properties"].items()
            return {name: self._value(one, depth + 1) for name, one in fields}
        kind = part.get("type")
        if is_list(kind):
            kind = next(iter(kind), "null")
        if kind == "array":
            return self._items(part, depth)
        if kind == "string":
            return _text(part)
        if kind in ("integer", "number"):
            return _number(part, _EMPTY[kind])
        return _EMPTY.get(str(kind), {})

    def _items(self, part: dict[Any, Any], depth: int) -> list[Any]:
        """Return as many items as a list needs."""
        parts = list(part.get("prefixItems", []))
        missing = _least(part, "minItems", len(parts) + self._left) - len(parts)
        parts += [part.get("items", True)] * missing
        return [self._value(one, depth + 1) for one in parts]


def _least(part: dict[Any, Any], keyword: str, most: int) -> int:
    """Return the least length that a schema demands; it may be infinite."""
    least: float = part.get(keyword, 0)
    if least > most:
        raise SchemaError("is too large for a template")
    return math.ceil(least)


def _text(part: dict[Any, Any]) -> str:
    """Return the shortest text of a schema; of its pattern nothing is known."""
    if part.get("format") in FORMATS:
        return FORMATS[part["format"]]
    sign = "A" if part.get("contentEncoding") == "base64" else "x"
    return sign * _least(part, "minLength", MAX_LENGTH)


def _number(part: dict[Any, Any], zero: float) -> Any:
    """Return zero, or the number within the limits that is next to it or easy to read."""
    least, above = part.get("minimum"), part.get("exclusiveMinimum")
    most, below = part.get("maximum"), part.get("exclusiveMaximum")
    unit = part.get("multipleOf")
    if is_number(least) and least > 0:
        return least if unit is None else _multiple(unit, least, zero)
    if is_number(above) and above >= 0:
        if unit is not None:
            return _multiple(unit, above, zero, beyond=True)
        end: Any = most if is_number(most) else below
        has_room = not is_number(end) or above + 1 < end
        return above + 1 if has_room or isinstance(zero, int) else (above + end) / 2
    if is_number(most) and most < 0:
        return most if unit is None else -_multiple(unit, -most, zero)
    if is_number(below) and below <= 0:
        return below - 1 if unit is None else -_multiple(unit, -below, zero, beyond=True)
    return zero


def _multiple(unit: float, limit: float, zero: float, *, beyond: bool = False) -> float:
    """Return the first multiple of a unit that is at least a limit, or `beyond` it, and that is
    one to msgspec, too, which compares floats; or else the limit.
    """
    try:
        first = int(limit // unit) + 1 if beyond else -int(-limit // unit)
    except (OverflowError, ValueError):  # a limit without an end
        return limit
    for count in range(first, first + MOST_MULTIPLES):
        number = count * unit
        is_whole = not isinstance(zero, int) or number == int(number)
        is_exact = isinstance(number, int) or float(number / unit).is_integer()
        if is_whole and is_exact and is_multiple_of(number, unit):
            return type(zero)(number)
    return limit

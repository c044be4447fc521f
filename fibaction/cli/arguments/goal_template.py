"""Templates of goals, made from the JSON Schema of an action, to be filled in.

The schema comes from a server: nothing is fetched, and the work is limited.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from itertools import islice
from typing import Any

from fibaction._runtime.plain_data import is_list, is_map, is_number, quoted
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.yaml_text import as_yaml
from fibaction.schema.json_schema import JsonSchema, SchemaError

MAX_PARTS = 500
"""Fields of a template."""
MAX_DEPTH = 10
"""Levels of fields within fields; a type may contain itself."""
MAX_VALUES = 10
"""Values of an enumeration that are named."""
MAX_CHARACTERS = 1000
"""Characters of a template that the shell completes."""

_SHELL_SAFE = re.compile(r'[A-Za-z0-9_ {}\[\]:,."+/-]*', re.ASCII)
"""The characters that mean themselves between single quotes, whatever a shell does with them."""

_EMPTY: dict[str, Any] = {"integer": 0, "number": 0.0, "string": "", "boolean": False, "null": None}
_FORMATS = {
    "date-time": "2026-01-31T12:00:00Z",
    "date": "2026-01-31",
    "time": "12:00:00",
    "duration": "PT1S",
    "uuid": "00000000-0000-0000-0000-000000000000",
}
_KINDS = {"integer": "a whole number", "number": "a number", "string": "text", "array": "a list"}


class GoalTemplate:
    """A goal with a value for each field: its default, or the empty value of its type."""

    def __init__(self, schema: dict[str, Any]) -> None:
        """Make the template of a schema; of one that cannot be used, it is an empty goal."""
        self._left = MAX_PARTS
        self._fields: dict[str, Any] = {}
        self._required: list[str] = []
        self.goal: Any = {}
        """The goal as plain data."""
        try:
            self._schema = JsonSchema(schema)
            root = self._resolved(self._schema.root)
            self.goal = self._value(root, 0)
        except SchemaError:
            return
        if is_map(self.goal):
            self._fields, self._required = root.get("properties", {}), root.get("required", [])

    def lines(self) -> Iterator[str]:
        """Yield the template as lines of YAML, with what is known of each field beside it."""
        if not (is_map(self.goal) and self.goal):
            yield as_yaml(self.goal)
            return
        for name, value in self.goal.items():
            first, *others = as_yaml({name: value}).split("\n")
            about = self._about(name)
            yield f"{first}  # {about}" if about else first
            yield from others

    def for_shell(self) -> str:
        """Return the template on one line; empty if a shell could change it, or it is too long."""
        try:
            text = json.dumps(self.goal)
        except (TypeError, RecursionError):  # a default of the server that is not JSON
            return ""
        if len(text) > MAX_CHARACTERS or not _SHELL_SAFE.fullmatch(text):
            return ""
        return text

    def _about(self, name: str) -> str:
        """Return the kind and the description of a field, and whether it is optional."""
        part = self._fields[name]
        if not is_map(part):
            return ""
        target = self._resolved(part)
        kind = _KINDS.get(str(target.get("type")), "")
        enum = target.get("enum")
        if enum:
            kind = f"one of {', '.join(quoted(one) for one in islice(enum, MAX_VALUES))}"
        elif target.get("contentEncoding") == "base64":
            kind = "bytes in base64"
        elif target.get("format") in _FORMATS:
            kind = str(target["format"])
        limits = [
            f"{word} {target[keyword]}"
            for keyword, word in (
                ("minimum", "at least"),
                ("maximum", "at most"),
                ("exclusiveMinimum", "more than"),
                ("exclusiveMaximum", "less than"),
            )
            if is_number(target.get(keyword))
        ]
        optional = [] if name in self._required else ["optional"]
        about = ", ".join(filter(None, [kind, *limits, *optional]))
        description = part.get("description", target.get("description", ""))
        texts = [about, description.partition("\n")[0] if isinstance(description, str) else ""]
        return excerpt(": ".join(filter(None, texts)))

    def _resolved(self, part: Any) -> dict[Any, Any]:
        """Return the schema behind references and alternatives."""
        for _ in range(MAX_DEPTH):
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
        if depth > MAX_DEPTH or self._left < 0:
            raise SchemaError("is too large for a template")
        if is_map(part) and "default" in part:
            return part["default"]
        part = self._resolved(part)
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
    if part.get("format") in _FORMATS:
        return _FORMATS[part["format"]]
    sign = "A" if part.get("contentEncoding") == "base64" else "x"
    return sign * _least(part, "minLength", MAX_CHARACTERS)


def _number(part: dict[Any, Any], zero: float) -> Any:
    """Return zero, or the number within the limits that is next to it or easy to read."""
    least, above = part.get("minimum"), part.get("exclusiveMinimum")
    most, below = part.get("maximum"), part.get("exclusiveMaximum")
    if is_number(least) and least > 0:
        return least
    if is_number(above) and above >= 0:
        end: Any = most if is_number(most) else below
        has_room = not is_number(end) or above + 1 < end
        return above + 1 if has_room or isinstance(zero, int) else (above + end) / 2
    if is_number(most) and most < 0:
        return most
    if is_number(below) and below <= 0:
        return below - 1
    return zero

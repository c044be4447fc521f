"""JSON Schemas of a peer: they are read once, refer only to themselves, and have a limited size.

`fibaction.schema.check` checks data with them, and explains the dangers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, cast
from urllib.parse import unquote

from fibaction.words.plain_data import is_list, is_map, is_number, quoted

MAX_PARTS = 20_000
"""Schemas within a schema."""

REFERENCES = ("$ref", "$dynamicRef", "$recursiveRef")
PARTS = ("items", "additionalProperties", "propertyNames", "not")
"""Keywords with a schema."""
LISTS_OF_PARTS = ("anyOf", "allOf", "oneOf", "prefixItems")
"""Keywords with a list of schemas."""


class SchemaError(ValueError):
    """An error for a schema that cannot be used, or with which a check takes too long.

    The text continues a sentence that begins with "the schema of the goal".
    """


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_count(value: object) -> bool:
    return is_number(value) and cast("float", value) >= 0


def _is_unit(value: object) -> bool:
    return is_number(value) and 0 < cast("float", value) < math.inf


def _is_names(value: object) -> bool:
    return is_list(value) and all(map(_is_text, value))


def _is_type(value: object) -> bool:
    return _is_text(value) or _is_names(value)


_SHAPES: dict[str, Callable[[object], bool]] = {
    **dict.fromkeys((*REFERENCES, "format", "contentEncoding"), _is_text),
    **dict.fromkeys(("minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum"), is_number),
    **dict.fromkeys(("minLength", "maxLength", "minItems", "maxItems"), _is_count),
    **dict.fromkeys(("minProperties", "maxProperties"), _is_count),
    **dict.fromkeys(("enum", *LISTS_OF_PARTS), is_list),
    "properties": is_map,
    "multipleOf": _is_unit,
    "type": _is_type,
    "required": _is_names,
    "uniqueItems": lambda value: isinstance(value, bool),
}
"""The test that the value of each keyword must pass."""


class JsonSchema:
    """A JSON Schema that is well-formed, not too large, and without references that lead only to
    themselves.

    Definitions that nothing refers to are not read. Reading does not recurse.
    """

    def __init__(self, root: Any) -> None:
        """Read a schema, which must not be changed later.

        Raises:
            SchemaError: It cannot be used.
        """
        self.root = root
        self._targets: dict[str, Any] = {}
        waiting, seen = [root], set[int]()
        while waiting:
            part = waiting.pop()
            if isinstance(part, bool) or id(part) in seen:
                continue
            if not is_map(part):
                raise SchemaError(f"is malformed: {quoted(part)} is not a schema")
            seen.add(id(part))
            waiting.extend(self._parts(part))
            if len(seen) + len(waiting) > MAX_PARTS:
                raise SchemaError(f"has more than {MAX_PARTS:,} parts")

    def target(self, reference: str) -> Any:
        """Return the schema that a reference names.

        Raises:
            SchemaError: The reference leads out of the schema, or to nothing.
        """
        if reference not in self._targets:
            self._targets[reference] = self._found(reference)
        return self._targets[reference]

    def _parts(self, part: dict[Any, Any]) -> Iterator[Any]:
        """Check one schema, and yield those that it contains or refers to."""
        for keyword, is_right in _SHAPES.items():
            if keyword in part and not is_right(part[keyword]):
                raise SchemaError(f'is malformed: "{keyword}" cannot be {quoted(part[keyword])}')
        for keyword in PARTS:
            if keyword in part:
                yield part[keyword]
        for keyword in LISTS_OF_PARTS:
            yield from part.get(keyword, ())
        for name, schema in part.get("properties", {}).items():
            if not isinstance(name, str):
                raise SchemaError(f"is malformed: {quoted(name)} is not the name of a field")
            yield schema
        self._check_end(part)
        for keyword in REFERENCES:
            if keyword in part:
                yield self.target(part[keyword])

    def _found(self, reference: str) -> Any:
        if reference not in ("", "#") and not reference.startswith("#/"):
            raise SchemaError(
                f"refers to {quoted(reference)}, which is outside of it; only references such as"
                f' "#/$defs/Name" are followed, and nothing is fetched'
            )
        found = self.root
        for step in unquote(reference).split("/")[1:]:  # RFC 6901, section 6
            step = step.replace("~1", "/").replace("~0", "~")
            if is_map(found) and step in found:
                found = found[step]
            elif is_list(found) and step.isdecimal() and int(step[:9]) < len(found):
                found = list(found)[int(step[:9])]
            else:
                raise SchemaError(f"refers to {quoted(reference)}, which is not in it")
        return found

    def _check_end(self, part: Any) -> None:
        """Check that the references from a part to the next one have an end."""
        seen = set[int]()
        while is_map(part) and isinstance(part.get("$ref"), str):
            if id(part) in seen:
                raise SchemaError(f"refers to itself without end, by {quoted(part['$ref'])}")
            seen.add(id(part))
            part = self.target(part["$ref"])

"""What the user's end of an action expects, read from the JSON Schemas in its description.

A description may come from another process, so a schema may be anything; what is not understood
counts as "anything goes". Knows nothing of ROS.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, TypeAlias, cast

Json: TypeAlias = Mapping[str, Any]

MISSING: Final[Any] = object()

ANYTHING = ""
"""The word for what may be anything."""
_WORDS = {
    "null": "nothing (null)",
    "boolean": "a bool",
    "integer": "an int",
    "number": "a float",
    "string": "a string",
    "bytes": "bytes",
    "datetime": "a datetime",
    "timedelta": "a timedelta",
    "array": "a list",
    "object": "a struct",
}
# What msgspec writes as a string in a schema, although it is none in msgpack.
_FORMATS = {"date-time": "datetime", "duration": "timedelta"}
_CONSTANTS = {bool: "boolean", int: "integer", float: "number", str: "string", type(None): "null"}


class Option:
    """One kind of value that the user's end takes at one place."""

    def __init__(self, word: str, schema: Json, root: Json) -> None:
        self.word = word
        """What it is: a type of JSON Schema, `bytes`, `datetime` or `timedelta`; or ANYTHING."""
        self._schema = schema
        self._root = root

    def __str__(self) -> str:
        return _WORDS.get(self.word, "anything")

    @property
    def names(self) -> list[str]:
        """The names of a struct's fields."""
        return list(_mapping(self._schema.get("properties")))

    def field(self, name: str) -> Schema | None:
        """What is expected in a field; None if there is no such field."""
        known = _mapping(self._schema.get("properties"))
        if name in known:
            return Schema(known[name], self._root)
        if isinstance(self._schema.get("properties"), dict):
            return None
        return Schema(self._schema.get("additionalProperties"), self._root)  # it is a dict

    @property
    def elements(self) -> list[Schema]:
        """What is expected in a list: one for all its elements, or one for each of a tuple."""
        each = _sequence(self._schema.get("prefixItems")) or [self._schema.get("items")]
        return [Schema(element, self._root) for element in each]

    @property
    def length(self) -> int | None:
        """How many elements a tuple has; None for a list, which may have any number."""
        least, most = self._schema.get("minItems"), self._schema.get("maxItems")
        return least if isinstance(least, int) and least == most else None


class Schema:
    """What the user's end expects at one place: one kind of value, or one of several."""

    def __init__(self, schema: object, root: Json | None = None) -> None:
        """`root` is the schema that references are looked up in: the outermost one."""
        schema = _mapping(schema)
        self._root = schema if root is None else root
        self.default: Any = schema.get("default", MISSING)
        """What a field has that is left out, in JSON; MISSING if it may not be left out."""
        options = list(_options(schema, self._root, set()))
        self.nullable = any(option.word == "null" for option in options)
        options = options or [Option(ANYTHING, {}, self._root)]
        self.options = [option for option in options if option.word != "null"] or options
        """What it may be, null not counted unless it is all that it may be."""


def _mapping(thing: object) -> Json:
    return cast("Json", thing) if isinstance(thing, dict) else {}


def _sequence(thing: object) -> Sequence[Any]:
    return cast("Sequence[Any]", thing) if isinstance(thing, list) else ()


def _options(schema: Json, root: Json, seen: set[str]) -> Iterator[Option]:
    """All that a schema allows. Each reference is followed once, so that a ring of them ends."""
    reference = schema.get("$ref")
    if isinstance(reference, str):
        if reference not in seen:
            seen.add(reference)
            name = reference.removeprefix("#/$defs/")
            yield from _options(_mapping(_mapping(root.get("$defs")).get(name)), root, seen)
        return
    alternatives = _sequence(schema.get("anyOf"))
    for one in alternatives:
        yield from _options(_mapping(one), root, seen)
    if not alternatives:
        for word in _words(schema):
            yield Option(word, schema, root)


def _words(schema: Json) -> list[str]:
    values = _sequence(schema.get("enum"))
    if values:
        return list(dict.fromkeys(_CONSTANTS.get(value.__class__, ANYTHING) for value in values))
    kind = schema.get("type")
    if not isinstance(kind, str) or kind not in _WORDS:
        return [ANYTHING]
    if kind == "string":
        if "contentEncoding" in schema:
            return ["bytes"]
        return [_FORMATS.get(str(schema.get("format")), kind)]
    return [kind]

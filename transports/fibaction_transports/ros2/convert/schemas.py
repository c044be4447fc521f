"""The types that the user's end of an action expects, read from JSON Schemas.

The schemas are those in the description of an action, which may come from another process. So a
schema may be anything, and one that is not understood counts as "any value". This module does not
use ROS.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, TypeAlias, cast

Json: TypeAlias = Mapping[str, Any]

MISSING: Final[Any] = object()

ANYTHING = ""
"""The word for a value of any kind."""
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
# Types that are strings in the schemas of msgspec, and not in msgpack.
_FORMATS = {"date-time": "datetime", "iso-date-time": "datetime", "duration": "timedelta"}
_CONSTANTS = {bool: "boolean", int: "integer", float: "number", str: "string", type(None): "null"}


class Option:
    """One kind of value that the user's end accepts at one place."""

    def __init__(self, word: str, schema: Json, root: Json) -> None:
        self.word = word
        """The kind: a type of JSON Schema, `bytes`, `datetime` or `timedelta`; or ANYTHING."""
        self._schema = schema
        self._root = root

    def __str__(self) -> str:
        return _WORDS.get(self.word, "anything")

    @property
    def names(self) -> list[str]:
        """The names of a struct's fields."""
        return list(_mapping(self._schema.get("properties")))

    def field(self, name: str) -> UserSchema | None:
        """Return the schema of a field; None if there is no such field."""
        known = _mapping(self._schema.get("properties"))
        if name in known:
            return UserSchema(known[name], self._root)
        if isinstance(self._schema.get("properties"), dict):
            return None
        return UserSchema(self._schema.get("additionalProperties"), self._root)  # a dict

    @property
    def elements(self) -> list[UserSchema]:
        """The schemas of the elements: one for all of a list, or one for each of a tuple."""
        each = _sequence(self._schema.get("prefixItems")) or [self._schema.get("items")]
        return [UserSchema(element, self._root) for element in each]

    @property
    def length(self) -> int | None:
        """The number of elements of a tuple; None for a list, which may have any number."""
        least, most = self._schema.get("minItems"), self._schema.get("maxItems")
        return least if isinstance(least, int) and least == most else None


class UserSchema:
    """The kinds of values that the user's end expects at one place: one, or one of several."""

    def __init__(self, schema: object, root: Json | None = None) -> None:
        """`root` is the outermost schema, in which references are looked up."""
        schema = _mapping(schema)
        self._root = schema if root is None else root
        self.default: Any = schema.get("default", MISSING)
        """The default of a field, in JSON; MISSING if the field must not be left out."""
        options = list(_options(schema, self._root, set()))
        self.nullable = any(option.word == "null" for option in options)
        options = options or [Option(ANYTHING, {}, self._root)]
        self.options = [option for option in options if option.word != "null"] or options
        """All kinds that are allowed. Null is listed only if it is the only one."""


def _mapping(thing: object) -> Json:
    return cast("Json", thing) if isinstance(thing, dict) else {}


def _sequence(thing: object) -> Sequence[Any]:
    return cast("Sequence[Any]", thing) if isinstance(thing, list) else ()


def _options(schema: Json, root: Json, seen: set[str]) -> Iterator[Option]:
    """Yield all that a schema allows. Each reference is followed once, so that cycles end."""
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

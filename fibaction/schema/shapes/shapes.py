"""`Shapes`: the shapes of one schema and its parts.

Theory of operation

`fibaction.schema.conversion` can do everything, and takes its time: it goes through a value three
times, and looks into the schema at each step. Most schemas have one of a few shapes: a scalar, a
list, a map of fields, and alternatives that the kind of the value or its tag tells apart. A shape
is prepared once for its schema. It goes through a value once, and takes a microsecond or so for
each part; a list of numbers it does not even copy.

A shape never decides against a value: where it does not see that the value matches, it asks
`converted`, which knows all keywords, for that value alone. So both agree, and the mismatch that is
found is the same. A schema that has no shape is left to `converted` as well.

What a shape returns shares its parts with the data and with the defaults, so it is only read.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import RLock
from typing import Any

from fibaction._runtime.plain_data import is_list, is_map
from fibaction.schema.check import COMBINATIONS, Check
from fibaction.schema.json_schema import JsonSchema
from fibaction.schema.keywords import COMPARISONS
from fibaction.schema.shapes.choices import ChoiceShape
from fibaction.schema.shapes.containers import FieldsShape, ListShape, TupleShape
from fibaction.schema.shapes.scalars import TYPES, ScalarShape, ValuesShape
from fibaction.schema.shapes.shape import NO_TYPES, AnyShape, SearchShape, Shape

MAX_LEVELS = 10
"""References and alternatives within each other that a shape has."""
_OF_MAPS = {"properties", "additionalProperties", "required", "minProperties", "maxProperties"}
_OF_LISTS = {"items", "prefixItems", "minItems", "maxItems"}
_CHECKED = {*COMPARISONS, *COMBINATIONS, *_OF_MAPS, *_OF_LISTS, "$ref", "patternProperties"}
"""All keywords that have an effect."""


class Shapes:
    """The shapes of one schema and its parts, which are made when they are needed first."""

    def __init__(self, schema: JsonSchema) -> None:
        self.root = schema.root
        self._schema = schema
        self._known: dict[int, Shape] = {}
        self._open: set[int] = set()
        self._lock = RLock()  # threads may share a codec

    def check(self, size: int = 1, pause: Callable[[], None] | None = None) -> Check:
        """Return a new check of data of this size; see `CheckSteps`."""
        return Check(self._schema, size, pause)

    def of(self, schema: Any) -> Shape:
        """Return the shape of a part of the schema."""
        return self._known.get(id(schema)) or self._made(schema)

    def _made(self, schema: Any) -> Shape:
        key = id(schema)
        with self._lock:
            if key in self._open or len(self._open) > MAX_LEVELS:
                return SearchShape(schema)
            self._open.add(key)
            try:
                shape = self._known[key] = self._new(schema)
            finally:
                self._open.remove(key)
        return shape

    def _new(self, schema: Any) -> Shape:
        if schema is True:
            return AnyShape(schema)
        if not is_map(schema):
            return SearchShape(schema)
        words = _CHECKED & schema.keys()
        if not words:
            return AnyShape(schema)
        if words == {"$ref"}:
            return self.of(self._schema.target(schema["$ref"]))
        for word in ("anyOf", "oneOf"):
            if words == {word}:
                parts = [self.of(part) for part in schema[word]]
                if all(part.kinds for part in parts):
                    return ChoiceShape(schema, parts)
        return self._of_kind(schema, words - {"type"}) or SearchShape(schema)

    def _of_kind(self, schema: dict[str, Any], words: set[str]) -> Shape | None:
        kind = schema.get("type")
        if kind == "object" and words <= _OF_MAPS:
            return FieldsShape(schema, self)
        if kind == "array" and words <= _OF_LISTS:
            if "prefixItems" not in words:
                return ListShape(schema, self)
            return TupleShape(schema, self) if schema.get("items") is False else None
        values = schema["enum"] if words == {"enum"} else [schema.get("const")]
        if words in ({"enum"}, {"const"}):
            is_plain = kind in (None, "string") and {str}.issuperset(map(type, values))
            return ValuesShape(schema, values) if is_plain else None
        names: list[Any] = list(kind) if is_list(kind) else [kind]
        if words <= COMPARISONS.keys() and names and all(name in TYPES for name in names):
            return ScalarShape(schema, NO_TYPES.union(*(TYPES[name] for name in names)))
        return None

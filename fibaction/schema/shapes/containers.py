"""The shapes of lists and of maps of fields."""

from __future__ import annotations

import math
from typing import Any

from fibaction._runtime.plain_data import is_map
from fibaction.schema.check import Check
from fibaction.schema.conversion import NoMatch, converted, converted_default, size_in_bytes
from fibaction.schema.json_schema import SchemaError
from fibaction.schema.shapes.shape import AnyShape, Shape, ShapeSource


class ListShape(Shape):
    """A list."""

    kinds = frozenset({list})

    def __init__(self, schema: dict[str, Any], shapes: ShapeSource) -> None:
        super().__init__(schema)
        self._shapes = shapes
        self._least, self._most = schema.get("minItems", 0), schema.get("maxItems", math.inf)
        self._rest: Shape | None = None

    def convert(self, check: Check, value: Any) -> Any:
        if type(value) not in self.kinds:
            return converted(check, value, self.schema)
        if not self._least <= len(value) <= self._most:
            return _judged(check, value, value, self.schema)
        check.steps.spend(1 + len(value))
        rest = self._rest
        if rest is None:
            rest = self._rest = self._shapes.of(self.schema.get("items", True))
        if isinstance(rest, AnyShape) or (rest.plain and rest.plain.issuperset(map(type, value))):
            return value
        made: list[Any] = []
        try:
            for item in value:
                made.append(rest.convert(check, item))  # noqa: PERF401  # its length is the index
        except NoMatch as exc:
            exc.way.append(len(made))
            raise
        return made


class TupleShape(Shape):
    """A list whose first items have a schema each, and that has no others."""

    kinds = frozenset({list})

    def __init__(self, schema: dict[str, Any], shapes: ShapeSource) -> None:
        super().__init__(schema)
        self._shapes = shapes

    def convert(self, check: Check, value: Any) -> Any:
        parts = self.schema["prefixItems"]
        check.steps.spend(1 + len(parts))
        if type(value) not in self.kinds or len(value) != len(parts):
            return converted(check, value, self.schema)
        made: list[Any] = []
        try:
            for item, part in zip(value, parts, strict=True):
                made.append(self._shapes.of(part).convert(check, item))
        except NoMatch as exc:
            exc.way.append(len(made))
            raise
        return made


class FieldsShape(Shape):
    """A map of fields."""

    kinds = frozenset({dict})

    def __init__(self, schema: dict[str, Any], shapes: ShapeSource) -> None:
        super().__init__(schema)
        self._shapes = shapes
        self._fields: _Fields | None = None

    def convert(self, check: Check, value: Any) -> Any:
        fields = self._fields
        if fields is None:  # when it is needed first: a type may have itself as a field
            fields = self._fields = _Fields(self.schema, self._shapes)
        if type(value) not in self.kinds or not fields.is_usable:
            return converted(check, value, self.schema)
        check.steps.spend(fields.cost + len(value))
        if not value and fields.empty is not None:
            check.steps.fill(fields.size)
            return fields.empty
        made = fields.template.copy()
        made.update(value)
        if len(made) > len(fields.template) and (
            fields.rest is None or not {str}.issuperset(map(type, value))
        ):
            return self._judged(check, value, fields)
        filled, parts, rest, name = fields.size, fields.parts, fields.rest, ""
        try:
            for name, item in value.items():
                part = parts.get(name) or rest
                filled -= fields.sizes.get(name, 0)
                if part is not None and type(item) not in part.plain:
                    made[name] = part.convert(check, item)
        except NoMatch as exc:
            exc.way.append(name)
            raise
        check.steps.fill(filled)
        if len(made) > len(value):  # otherwise no field is missing
            for name in fields.bare:
                if name not in value:
                    if name in fields.required:
                        return self._judged(check, value, fields)
                    del made[name]
        if not fields.least <= len(made) <= fields.most:
            return self._judged(check, value, fields)
        if not value:
            fields.empty = made
        return made

    def _judged(self, check: Check, value: dict[Any, Any], fields: _Fields) -> Any:
        defaults = {name: fields.template[name] for name in fields.sizes}
        return _judged(check, value, defaults | value, self.schema)


def _judged(check: Check, value: Any, whole: Any, schema: Any) -> Any:
    """Raise the mismatch of a value itself, without a look at its parts; convert it if it has none.

    `whole` is the value with its defaults.
    """
    mismatch = next(check.mismatches(whole, schema), None)
    if mismatch is not None and not mismatch.path:
        raise NoMatch(mismatch)
    return converted(check, value, schema)


class _Fields:
    """The fields of a map."""

    def __init__(self, schema: dict[str, Any], shapes: ShapeSource) -> None:
        known: dict[str, Any] = schema.get("properties", {})
        self.parts = {name: shapes.of(part) for name, part in known.items()}
        rest = schema.get("additionalProperties", "properties" not in schema)
        self.rest = None if rest is False else shapes.of(rest)
        """The shape of other fields; None if there are no others."""
        self.required = frozenset(schema.get("required", ()))
        self.least = schema.get("minProperties", 0)
        self.most = schema.get("maxProperties", math.inf)
        self.template: dict[str, Any] = dict.fromkeys(known)
        """The default of each field; None if it has none."""
        self.sizes: dict[str, int] = {}
        """The bytes of each default."""
        self.is_usable = self.required <= known.keys()
        """True if the defaults are of their types, and not too large."""
        try:
            for name, part in known.items():
                if is_map(part) and "default" in part:
                    self.template[name] = converted_default(shapes.check(), part)
                    self.sizes[name] = size_in_bytes({name: part["default"]})
        except (NoMatch, SchemaError):
            self.is_usable = False
        self.size = sum(self.sizes.values())
        self.bare = [name for name in known if name not in self.sizes]
        """The fields without a default."""
        self.cost = 1 + len(self.bare) + len(known) // 10
        """The steps of each map."""
        self.empty: dict[str, Any] | None = None
        """The map that an empty one is sent as, once there was one."""

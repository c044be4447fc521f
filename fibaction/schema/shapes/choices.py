"""The shapes of alternatives."""

from __future__ import annotations

from typing import Any

from fibaction.schema.check import Check
from fibaction.schema.conversion import converted
from fibaction.schema.mismatch import only_value
from fibaction.schema.shapes.containers import FieldsShape
from fibaction.schema.shapes.shape import SearchShape, Shape


class ChoiceShape(Shape):
    """Alternatives that the type of a value tells apart, or the tag of a map."""

    def __init__(self, schema: dict[str, Any], parts: list[Shape]) -> None:
        super().__init__(schema)
        found: dict[type, list[Shape]] = {}
        for part in parts:
            for kind in part.kinds:
                found.setdefault(kind, []).append(part)
        search = SearchShape(schema)
        self._shapes = {
            kind: some[0] if len(some) == 1 else TagShape.of(schema, some) or search
            for kind, some in found.items()
        }
        self._search = search
        self.kinds = frozenset(found)
        self.plain = frozenset(kind for kind, part in self._shapes.items() if kind in part.plain)

    def convert(self, check: Check, value: Any) -> Any:
        return self._shapes.get(value.__class__, self._search).convert(check, value)


class TagShape(Shape):
    """Maps of fields that one field tells apart."""

    kinds = frozenset({dict})

    def __init__(self, schema: dict[str, Any], name: str, parts: dict[str, Shape]) -> None:
        super().__init__(schema)
        self._name = name
        self._parts = parts

    @classmethod
    def of(cls, schema: dict[str, Any], parts: list[Shape]) -> TagShape | None:
        """Return the shape of alternatives; None if nothing tells them apart."""
        if not all(isinstance(part, FieldsShape) for part in parts):
            return None
        fields = [part.schema.get("properties", {}) for part in parts]
        for name in fields[0]:
            only = [only_value(one.get(name)) for one in fields]
            tags = {
                one[0]: part
                for one, part in zip(only, parts, strict=True)
                if one and type(one[0]) is str
            }
            if len(tags) == len(parts):
                return cls(schema, name, tags)
        return None

    def convert(self, check: Check, value: Any) -> Any:
        tag = value.get(self._name)
        part = self._parts.get(tag) if type(tag) is str else None
        return converted(check, value, self.schema) if part is None else part.convert(check, value)

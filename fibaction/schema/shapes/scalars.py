"""The shapes of scalars."""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any

from fibaction.schema.check import Check
from fibaction.schema.conversion import bytes_of, converted
from fibaction.schema.keywords import COMPARISONS
from fibaction.schema.shapes.shape import NO_TYPES, Shape

TYPES: dict[str, frozenset[type]] = {
    "null": frozenset({type(None)}),
    "boolean": frozenset({bool}),
    "integer": frozenset({int}),
    "number": frozenset({int, float}),
    "string": frozenset({str}),
}
"""The types of Python that each type of a schema has."""
_LISTS: frozenset[type] = frozenset({list})


class ScalarShape(Shape):
    """Numbers, texts, bytes, true and false, null."""

    def __init__(self, schema: dict[str, Any], types: frozenset[type]) -> None:
        super().__init__(schema)
        self._is_base64 = schema.get("contentEncoding") == "base64"
        self._types = types
        self._tests: list[tuple[Callable[[Any, Any], bool], Any]] = [
            (holds, schema[word])
            for word, holds in COMPARISONS.items()
            if word in schema and word not in ("type", "contentEncoding")
        ]
        self.kinds = types | ({float} if int in types else NO_TYPES)
        if not (self._tests or self._is_base64):
            self.plain = types

    def convert(self, check: Check, value: Any) -> Any:
        if self._is_base64:
            if self._tests:  # of the length of the text, whatever the value is
                return converted(check, value, self.schema)
            if isinstance(value, str):
                try:
                    return base64.b64decode(value, validate=True)
                except ValueError:
                    pass
            elif type(value) in _LISTS:
                check.steps.spend(len(value))
                value = bytes_of(value)
            if isinstance(value, bytes):
                return value
        elif type(value) in self._types and all(holds(value, one) for holds, one in self._tests):
            return value
        return converted(check, value, self.schema)


class ValuesShape(Shape):
    """Some texts."""

    kinds = frozenset({str})

    def __init__(self, schema: dict[str, Any], values: list[Any]) -> None:
        super().__init__(schema)
        self._values = frozenset(values)

    def convert(self, check: Check, value: Any) -> Any:
        if type(value) is str and value in self._values:
            return value
        return converted(check, value, self.schema)

"""`Shape`, and the two shapes that need no look at the schema."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Protocol

from fibaction.schema.check import Check
from fibaction.schema.conversion import converted

NO_TYPES: frozenset[type] = frozenset()


class Shape(ABC):
    """The way of the values of one schema to what is sent."""

    plain: frozenset[type] = NO_TYPES
    """The types of which each value is sent as it is."""
    kinds: frozenset[type] = NO_TYPES
    """The types that a value may have so that this shape can tell that it matches."""

    def __init__(self, schema: Any) -> None:
        self.schema = schema

    @abstractmethod
    def convert(self, check: Check, value: Any) -> Any:
        """Return a value as it is sent, with the defaults of fields that are missing.

        Raises:
            NoMatch: The value does not match.
            SchemaError: The check takes too many steps.
        """


class AnyShape(Shape):
    """A schema that allows everything."""

    def convert(self, check: Check, value: Any) -> Any:
        return value


class SearchShape(Shape):
    """A schema that has no other shape."""

    def convert(self, check: Check, value: Any) -> Any:
        return converted(check, value, self.schema)


class ShapeSource(Protocol):
    """The shapes of all parts of a schema."""

    def of(self, schema: Any) -> Shape:
        """Return the shape of a part of the schema."""
        ...

    def check(self) -> Check:
        """Return a new check of a small value."""
        ...

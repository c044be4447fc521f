"""`Mismatch`: one reason why data does not match a JSON Schema."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

from fibaction._runtime.plain_data import is_map

Path: TypeAlias = tuple[str | int, ...]


class Mismatch(NamedTuple):
    """One reason why data does not match a schema."""

    path: Path
    """The names and indices that lead to the value."""
    keyword: str
    expected: Any
    """The value of the keyword."""
    value: Any
    schema: dict[str, Any]
    alternatives: tuple[list[Mismatch], ...] = ()
    """The mismatches of each alternative, of `anyOf`."""
    is_other_kind: bool = False
    """True if the value is of another type, and not only of a wrong content."""

    def excludes(self, path: Path) -> bool:
        """Return whether the value at `path` is of another kind, or has another tag."""
        if self.path == path:
            return self.is_other_kind
        return only_value(self.schema) is not None and len(self.path) == len(path) + 1


def only_value(schema: Any) -> tuple[Any] | None:
    """Return the only value that a schema allows, as a tuple; None if it may allow several."""
    if not is_map(schema):
        return None
    values = [schema["const"]] if "const" in schema else schema.get("enum", ())
    return (values[0],) if len(values) == 1 else None

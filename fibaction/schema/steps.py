"""The steps of one check by a JSON Schema: what they are counted by, and how many there may be."""

from __future__ import annotations

from typing import Any

from fibaction._runtime.plain_data import is_list, is_map
from fibaction.schema.json_schema import SchemaError

STEPS = 100_000
"""CheckSteps of a check, whatever the data is; they take some tenths of a second."""
STEPS_PER_VALUE = 50
"""More steps for each value of the data, and for each `TEXT_PER_STEP` characters of it."""
TEXT_PER_STEP = 100


def size_of(value: Any) -> int:
    """Return the number of values in plain data, where text counts by its length as well."""
    if value is None or isinstance(value, (int, float)):
        return 1
    if is_map(value):
        return 1 + sum(size_of(str(key)) + size_of(item) for key, item in value.items())
    if is_list(value):
        return 1 + sum(map(size_of, value))
    return 1 + text_steps(value)


def text_steps(value: object) -> int:
    """Return the steps for the characters of a text, or for bytes; 0 for any other value."""
    return len(value) // TEXT_PER_STEP if isinstance(value, (str, bytes)) else 0


class CheckSteps:
    """The steps that are left for the check of one message."""

    __slots__ = ("_left", "_limit")

    def __init__(self, size: int) -> None:
        """Allow as many steps as data of this size may need; see `size_of`."""
        self._limit = self._left = STEPS + STEPS_PER_VALUE * size

    def spend(self, steps: int = 1) -> None:
        """Count steps.

        Raises:
            SchemaError: They are too many.
        """
        self._left -= steps
        if self._left < 0:
            raise SchemaError(f"is too complex: a check by it takes over {self._limit:,} steps")


def are_equal(steps: CheckSteps, one: Any, other: Any) -> bool:
    """Return whether two values are the same in JSON, where true is not 1, but 1.0 is.

    Raises:
        SchemaError: The comparison takes too many steps.
    """
    steps.spend(1 + text_steps(one))
    if is_map(one) and is_map(other):
        return one.keys() == other.keys() and all(
            are_equal(steps, one[key], other[key]) for key in one
        )
    if is_list(one) and is_list(other):
        pairs = zip(one, other, strict=False)
        return len(one) == len(other) and all(are_equal(steps, *pair) for pair in pairs)
    return isinstance(one, bool) == isinstance(other, bool) and bool(one == other)

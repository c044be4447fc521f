"""The steps of one check by a JSON Schema: what they are counted by, and how many there may be."""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain
from typing import Any, NamedTuple

from fibaction.schema.json_schema import SchemaError
from fibaction.words.plain_data import is_list, is_map

STEPS = 20_000
"""Steps of a check, whatever the data is; they take some hundredths of a second."""
STEPS_PER_VALUE = 50
"""More steps for each value of the data, and for each `TEXT_PER_STEP` characters of it."""
TEXT_PER_STEP = 100
FILLED = 2**20
"""Bytes of defaults that a check may fill in, whatever the data is."""
FILLED_PER_VALUE = 32
"""More bytes of defaults for each value of the data."""
TURN = 1000
"""Steps between two pauses: about a millisecond."""

_TEXTS: frozenset[type] = frozenset({str, bytes})
CONTAINERS: frozenset[type] = frozenset({dict, list})


class Extent(NamedTuple):
    """The extent of plain data."""

    size: int
    """The number of values, where text counts by its length as well."""
    levels: int
    """Lists and maps within each other."""

    @classmethod
    def of(cls, value: Any) -> Extent:
        """Return the extent of data. It counts one level after another, which is fast."""
        size, levels = 0, 0
        values: list[Any] = [value]
        while True:
            texts = [one for one in values if type(one) in _TEXTS]
            size += len(values) + sum(map(text_steps, texts))
            parts = [one for one in values if type(one) in CONTAINERS]
            if not parts:
                return cls(size, levels)
            levels += 1
            inner = (chain(one, one.values()) if is_map(one) else one for one in parts)
            values = [*chain.from_iterable(inner)]


def text_steps(value: object) -> int:
    """Return the steps for the characters of a text, or for bytes; 0 for any other value."""
    return len(value) // TEXT_PER_STEP if isinstance(value, (str, bytes)) else 0


class CheckSteps:
    """The steps that are left for the check of one message."""

    __slots__ = ("_granted", "_left", "_limit", "_pause", "_room", "_room_left")

    def __init__(self, size: int, pause: Callable[[], None] | None = None) -> None:
        """Allow as many steps as data of this size may need; see `Extent`.

        `pause` is called after each `TURN` of them.
        """
        self._pause = pause
        self._limit = STEPS + STEPS_PER_VALUE * size
        self._room = self._room_left = FILLED + FILLED_PER_VALUE * size
        self._granted = self._left = 0

    @property
    def spent(self) -> int:
        """The steps so far."""
        return self._granted - self._left

    def spend(self, steps: int = 1) -> None:
        """Count steps.

        Raises:
            SchemaError: They are too many.
        """
        self._left -= steps
        if self._left < 0:
            self._grant()

    def fill(self, size: int) -> None:
        """Count bytes of defaults.

        Raises:
            SchemaError: They are too many.
        """
        self._room_left -= size
        if self._room_left < 0:
            raise SchemaError(
                f"has too many defaults: in this message they take over {self._room:,} bytes"
            )

    def _grant(self) -> None:
        wanted = self._granted - self._left
        if wanted > self._limit:
            raise SchemaError(f"is too complex: a check by it takes over {self._limit:,} steps")
        more = min(TURN, self._limit - wanted)
        self._granted, self._left = wanted + more, more
        if self._pause is not None:
            self._pause()


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

"""`ExpiringMap`: entries about goals, kept for a fixed time and up to a limited number.

Sans-I/O: the time is an argument. Expiry is exact, whether or not the memory has been freed: `get`
compares the time, and `expire` frees.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterator
from typing import Generic, TypeVar

from fibaction.words.goals import GoalID

T = TypeVar("T")


class ExpiringMap(Generic[T]):
    """A bounded mapping whose entries expire after a fixed time."""

    def __init__(self, seconds: float, limit: int) -> None:
        """Make an empty map.

        Each entry is kept for `seconds` (0 not at all, `math.inf` forever), and at most `limit`
        entries are kept: the oldest are removed.
        """
        self._seconds = seconds
        self._limit = limit
        self._entries: OrderedDict[GoalID, tuple[float, T]] = OrderedDict()

    def __iter__(self) -> Iterator[T]:
        return (value for _, value in self._entries.values())

    def put(self, goal_id: GoalID, value: T, now: float, *, at_least_until: float = 0.0) -> None:
        """Add an entry, whose time begins now. Call `expire` afterwards to keep the limit."""
        self._entries.pop(goal_id, None)  # as in `put_until`, which another call would add to
        self._entries[goal_id] = (max(now + self._seconds, at_least_until), value)

    def put_until(self, goal_id: GoalID, value: T, until: float) -> None:
        """Add an entry that expires then. It is freed after all entries that were added before."""
        self._entries.pop(goal_id, None)  # an old entry would keep its place in the order
        self._entries[goal_id] = (until, value)

    def discard(self, goal_id: GoalID | None) -> T | None:
        """Remove the entry, if there is one, and return its value."""
        entry = None if goal_id is None else self._entries.pop(goal_id, None)
        return None if entry is None else entry[1]

    def get(self, goal_id: GoalID, now: float) -> T | None:
        """Return the value; None if it is missing, or has expired."""
        entry = self._entries.get(goal_id)
        return None if entry is None or entry[0] <= now else entry[1]

    def expire(self, now: float, most: float) -> list[T]:
        """Remove the oldest entries, at most so many, as long as the next one is too old or there
        are too many; return their values.
        """
        entries = self._entries
        gone: list[T] = []
        while entries and len(gone) < most:
            if len(entries) <= self._limit and next(iter(entries.values()))[0] > now:
                break
            gone.append(entries.popitem(last=False)[1][1])
        return gone

    @property
    def next_expiry(self) -> float:
        """The time at which the next entry expires; `math.inf` if none does."""
        # Those that are put expire in their order; one with a time of its own waits for its turn.
        return next(iter(self._entries.values()))[0] if self._entries else math.inf

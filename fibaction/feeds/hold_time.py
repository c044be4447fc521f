"""`HoldTime`: the time for which an executor may wait for a reader that holds it."""

from __future__ import annotations

import math

from anyio import current_time

MOST = 0.5
"""Seconds of waiting at once, in which a burst of feedback gets through to a reader that reads."""
LEAST = 0.001
"""Seconds that are not worth a wait."""
SHARE = 0.1
"""Share of the time that may be spent on waiting: so the executor is slowed by a tenth at most."""


class HoldTime:
    """A time without a limit of its own: that of the server counts."""

    __slots__ = ()

    def left(self) -> float:
        """Return the seconds that are left now."""
        return math.inf

    def spend(self, seconds: float) -> bool:
        """Take the seconds of a wait that has ended now; return whether any are left."""
        return True


UNLIMITED_TIME = HoldTime()


class BriefHold(HoldTime):
    """A bucket of seconds: waiting takes from it, and time fills it again."""

    __slots__ = ("_at", "_left")

    def __init__(self) -> None:
        self._left = MOST
        self._at = current_time()

    def left(self) -> float:
        now = current_time()
        self._left = min(MOST, self._left + SHARE * (now - self._at))
        self._at = now
        return self._left

    def spend(self, seconds: float) -> bool:
        self._left -= seconds
        self._at = current_time()
        return self._left > LEAST

"""Deadlines without a clock: callbacks that are due at a time, which the caller of `run` tells."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

TimerCallback: TypeAlias = Callable[[float], None]


class Timers:
    """Callbacks, each with one time at which it is due.

    Bound methods of the same object are equal, so setting one again moves its time.
    """

    def __init__(self) -> None:
        self._times: dict[TimerCallback, float] = {}

    def set(self, callback: TimerCallback, when: float) -> None:
        """Call back at this time, and not at the time set before."""
        self._times[callback] = when

    def set_earlier(self, callback: TimerCallback, when: float) -> None:
        """Call back at this time, unless an earlier one is set."""
        self._times[callback] = min(when, self._times.get(callback, math.inf))

    def cancel(self, callback: TimerCallback) -> None:
        """Do not call back."""
        self._times.pop(callback, None)

    def clear(self) -> None:
        """Call nothing back."""
        self._times.clear()

    def next(self) -> float:
        """Return the time of the next callback; infinity if there is none."""
        return min(self._times.values(), default=math.inf)

    def run(self, now: float) -> None:
        """Call back what is due. A callback may set and cancel any."""
        for callback in [callback for callback, when in self._times.items() if when <= now]:
            if self._times.get(callback, math.inf) <= now:  # another one may have canceled it
                del self._times[callback]
                callback(now)

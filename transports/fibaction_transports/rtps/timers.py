"""Deadlines without a clock: callbacks that are due at a time, which the caller of `run` tells.

The queue is a heap with one valid entry for each callback. A callback that is set to a later time
keeps its entry, which moves when it comes to the front: most deadlines are put off many times, and
are never due. An entry of a callback that was canceled, or set to an earlier time, stays until it
comes to the front, or until there are more of them than of the others.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from heapq import heapify, heappop, heappush, heapreplace
from itertools import count
from typing import TypeAlias

from msgspec import Struct

TimerCallback: TypeAlias = Callable[[float], None]

_FEW = 64
"""Invalid entries that the queue may have in any case."""


class _Timer(Struct, eq=False):
    """The time of one callback."""

    callback: TimerCallback
    when: float
    queued: float = math.inf
    """The time of its entry in the queue."""


class Timers:
    """Callbacks, each with one time at which it is due.

    Bound methods of the same object are equal, so setting one again moves its time.
    """

    def __init__(self) -> None:
        self._timers: dict[TimerCallback, _Timer] = {}
        self._queue: list[tuple[float, int, _Timer]] = []
        self._order = count()

    def set(self, callback: TimerCallback, when: float) -> None:
        """Call back at this time, and not at the time set before."""
        timer = self._timers.get(callback)
        if timer is None:
            timer = self._timers[callback] = _Timer(callback, when)
        timer.when = when
        if when < timer.queued:
            timer.queued = when
            heappush(self._queue, (when, next(self._order), timer))
            if len(self._queue) > 2 * len(self._timers) + _FEW:
                self._queue = [entry for entry in self._queue if self._is_valid(entry)]
                heapify(self._queue)

    def set_earlier(self, callback: TimerCallback, when: float) -> None:
        """Call back at this time, unless an earlier one is set."""
        timer = self._timers.get(callback)
        if timer is None or when < timer.when:
            self.set(callback, when)

    def cancel(self, callback: TimerCallback) -> None:
        """Do not call back."""
        self._timers.pop(callback, None)

    def clear(self) -> None:
        """Call nothing back."""
        self._timers.clear()
        self._queue.clear()

    def next(self) -> float:
        """Return the time of the next callback; infinity if there is none."""
        queue, timers = self._queue, self._timers
        while queue:
            when, order, timer = queue[0]
            if timer.queued != when or timers.get(timer.callback) is not timer:
                heappop(queue)
            elif timer.when > when:
                timer.queued = timer.when
                heapreplace(queue, (timer.when, order, timer))
            else:
                return when
        return math.inf

    def run(self, now: float) -> None:
        """Call back what is due. A callback may set and cancel any."""
        due = list[_Timer]()
        while self.next() <= now:
            timer = heappop(self._queue)[2]
            timer.queued = math.inf
            due.append(timer)
        for timer in due:
            # Another one may have canceled it, or put it off.
            if self._timers.get(timer.callback) is timer and timer.when <= now:
                del self._timers[timer.callback]
                timer.callback(now)

    def _is_valid(self, entry: tuple[float, int, _Timer]) -> bool:
        when, _, timer = entry
        return timer.queued == when and self._timers.get(timer.callback) is timer

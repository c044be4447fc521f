"""Callbacks at their times, by a clock of the caller."""

from __future__ import annotations

import math

from fibaction_transports.rtps.timers import Timers


class Alarm:
    def __init__(self, timers: Timers) -> None:
        self.timers = timers
        self.rung: list[float] = []
        self.cancels: Alarm | None = None

    def ring(self, now: float) -> None:
        self.rung.append(now)
        if self.cancels is not None:
            self.timers.cancel(self.cancels.ring)


def test_a_callback_is_called_once_at_the_time_that_was_set_last() -> None:
    timers = Timers()
    alarm = Alarm(timers)
    assert timers.next() == math.inf
    timers.set(alarm.ring, 5.0)
    timers.set(alarm.ring, 7.0)
    timers.set_earlier(alarm.ring, 9.0)
    assert timers.next() == 7.0
    timers.set_earlier(alarm.ring, 6.0)
    timers.run(5.9)
    timers.run(6.0)
    timers.run(9.0)
    assert alarm.rung == [6.0]


def test_a_callback_may_cancel_another_one() -> None:
    timers = Timers()
    one, other = Alarm(timers), Alarm(timers)
    one.cancels = other
    timers.set(one.ring, 1.0)
    timers.set(other.ring, 1.0)
    timers.run(2.0)
    assert (one.rung, other.rung) == ([2.0], [])
    timers.set(other.ring, 3.0)
    timers.clear()
    timers.run(4.0)
    assert other.rung == []

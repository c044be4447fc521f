"""`TimedGoals`: the goals that run, and what is due for them because time has passed.

Those that wait are the scheduler's, and what is due for them, too.
"""

from __future__ import annotations

import math
from collections import OrderedDict

from fibaction.server.scheduling.group import Entry
from fibaction.server.scheduling.orders import Act, Order
from fibaction.server.scheduling.schedule import Schedule
from fibaction.words.goals import GoalID


class TimedGoals:
    """The goals that run, until they are killed.

    Each mapping is in the order of its times, so that the first is due first. To find the first of
    a plain dict takes longer, the more have been removed before it.
    """

    def __init__(self, schedule: Schedule, kill_after: float) -> None:
        self._schedule = schedule
        self._kill_after = kill_after
        self.running: OrderedDict[GoalID, Entry] = OrderedDict()
        """Those that were not interrupted, since their start."""
        self.told: OrderedDict[GoalID, Entry] = OrderedDict()
        """Of these, those that may take their successors over, since they were told so."""
        self.interrupted: OrderedDict[GoalID, Entry] = OrderedDict()
        """Those that were interrupted, since then."""

    def tell(self, entry: Entry, now: float) -> Order:
        """Let a goal take its successor over, for a time."""
        self.told[entry.goal_id] = entry
        entry.told_at = now
        return Order(Act.TELL, entry.goal_id)

    def interrupt(self, entry: Entry, reason: str, now: float) -> Order:
        """Interrupt a goal that was not interrupted before."""
        del self.running[entry.goal_id]
        self.told.pop(entry.goal_id, None)
        self.interrupted[entry.goal_id] = entry
        entry.since = now
        return Order(Act.INTERRUPT, entry.goal_id, reason)

    def remove(self, goal_id: GoalID) -> None:
        """Let nothing be due for a goal any more."""
        self.running.pop(goal_id, None)
        self.told.pop(goal_id, None)
        self.interrupted.pop(goal_id, None)

    def next_order(self, now: float) -> Order | None:
        """Return one order that is due, and take it as carried out; None if none is due."""
        rules = self._schedule
        if (entry := _first(self.running)) and entry.since + rules.run_timeout <= now:
            return self.interrupt(entry, f"took longer than {rules.run_timeout:g} s", now)
        if (entry := _first(self.told)) and entry.told_at + rules.handover <= now:
            assert entry.successor is not None
            return self.interrupt(entry, f"preempted by {entry.successor.goal_id}", now)
        if (entry := _first(self.interrupted)) and entry.since + self._kill_after <= now:
            del self.interrupted[entry.goal_id]
            return Order(Act.KILL, entry.goal_id)
        return None

    def next_due(self) -> float:
        """Return the time at which the next order is due; `math.inf` if time alone makes none."""
        rules, due = self._schedule, math.inf
        if rules.run_timeout < math.inf and (entry := _first(self.running)):
            due = entry.since + rules.run_timeout
        if self.told and (entry := _first(self.told)):
            due = min(due, entry.told_at + rules.handover)
        if self.interrupted and (entry := _first(self.interrupted)):
            due = min(due, entry.since + self._kill_after)
        return due


def _first(entries: OrderedDict[GoalID, Entry]) -> Entry | None:
    return next(iter(entries.values()), None)

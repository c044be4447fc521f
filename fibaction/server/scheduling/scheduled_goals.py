"""The goals of a scheduler: an `Entry` for each, by key and by time, and the `Order`s about them.

A `Group` has the goals of one key. `WaitingGoals` and `TimedGoals` have those of all keys that wait
and that run, in the order in which something is due for them.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Hashable
from enum import Enum
from heapq import heapify, heappop, heappush
from typing import Any, NamedTuple, TypeAlias

from fibaction.server.scheduling.schedule import Schedule
from fibaction.words.errors import GoalRejected, RejectionCode
from fibaction.words.goals import GoalID

Urgency: TypeAlias = tuple[float, int]
"""The place of a goal in the order of those that wait: smaller is first, and no two are equal."""


class Act(Enum):
    """A kind of order."""

    START = "start"
    """Run the goal's executor."""
    END = "end"
    """End a goal that has not started, for the reason. It has left already."""
    TELL = "tell"
    """Tell the goal's executor that it has a successor, which it may take over."""
    INTERRUPT = "interrupt"
    """Interrupt the goal's executor for the reason; call `leave` when it has ended."""
    KILL = "kill"
    """Kill the goal's executor, which was interrupted and has not ended in time; call `leave`."""


class Order(NamedTuple):
    """One step that the caller of a scheduler carries out."""

    act: Act
    goal_id: GoalID
    reason: str = ""
    owner: Any = None
    """The owner of the goal, as `Scheduler.offer` was told."""


class Busy(GoalRejected):
    """A goal can neither run nor wait; the reason says how many do."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason, code=RejectionCode.BUSY)


class Entry:
    """A goal that runs or waits."""

    __slots__ = (
        "expires",
        "goal_id",
        "group",
        "owner",
        "predecessor",
        "since",
        "successor",
        "told_at",
        "urgency",
    )

    def __init__(
        self,
        goal_id: GoalID,
        group: Group,
        urgency: Urgency,
        now: float,
        expires: float,
        owner: object,
    ) -> None:
        self.goal_id = goal_id
        self.owner = owner
        self.group = group
        self.urgency = urgency
        self.since = now
        """The time of its arrival, of its start, or of its interruption: the latest of them."""
        self.expires = expires
        """The time from which it is not wanted any more, unless it has started."""
        self.told_at = 0.0
        """The time from which it may take its successor over."""
        self.predecessor: Entry | None = None
        """The goal that is interrupted for this one."""
        self.successor: Entry | None = None
        """The goal that starts when this one has left."""

    def order(self, act: Act, reason: str = "") -> Order:
        """Return an order for this goal."""
        return Order(act, self.goal_id, reason, self.owner)

    @property
    def last(self) -> Entry:
        """The goal for which its place is kept: its successor, or itself."""
        return self.successor or self


class Group:
    """The goals of one key."""

    def __init__(self, key: Hashable) -> None:
        self.key = key
        self.running: dict[GoalID, Entry] = {}  # in the order of their start
        self.queue: dict[GoalID, Entry] = {}  # in the order of their arrival
        self.asked = 0
        """Places that its waiting goals have been asked for at other servers: see `FleetScheduler`.
        """
        self.listed: Urgency | None = None
        """The goal with which the group stands in the order of groups; None if it does not."""
        self._heap: list[tuple[Urgency, Entry]] = []

    def add(self, entry: Entry) -> None:
        """Add a goal to the queue."""
        self.queue[entry.goal_id] = entry
        if len(self._heap) > 2 * len(self.queue) + 16:  # most are those of goals that have left
            self._heap = [(one.urgency, one) for one in self.queue.values()]
            heapify(self._heap)
        else:
            heappush(self._heap, (entry.urgency, entry))

    def first(self) -> Entry | None:
        """Return the goal of the queue that starts next."""
        while self._heap:
            entry = self._heap[0][1]
            # A goal that was sent again after its end has another entry.
            if self.queue.get(entry.goal_id) is entry:
                return entry
            heappop(self._heap)
        return None

    def next_successor(self) -> Entry | None:
        """Return the successor that starts next in any place that is free."""
        successors = [entry.successor for entry in self.running.values() if entry.successor]
        return min(successors, key=lambda one: one.urgency, default=None)

    def oldest(self) -> Entry | None:
        """Return the goal that has run longest, without successor if any is; else the one with the
        oldest successor.
        """
        for entry in self.running.values():
            if entry.successor is None:
                return entry
        return min(self.running.values(), key=lambda one: one.last.urgency[1], default=None)

    def least_urgent(self) -> Entry | None:
        """Return the running goal that is least urgent, as `oldest` does among equal ones."""
        running = self.running.values()
        free = [entry for entry in running if entry.successor is None]
        return max(free or running, key=_least_urgent_first, default=None)


def _least_urgent_first(entry: Entry) -> tuple[float, int]:
    """Return a key by which the least urgent goal is the largest, and of those the oldest."""
    urgency, arrival = entry.last.urgency
    return urgency, -arrival


def busy_text(schedule: Schedule, group: Group, running: int) -> str:
    """Return why a goal of a group can neither run nor wait, while so many run in all groups."""
    waiting = f"{len(group.queue)} of {schedule.queue} waiting"
    if schedule.fleet_limit:
        return f"busy: {waiting} at this worker"  # it does not know how many run elsewhere
    in_all = f"{running} of {schedule.total}"
    if schedule.concurrency is None:
        return f"busy: {in_all} running, {waiting}"
    text = f"busy: {len(group.running)} of {schedule.concurrency} running"
    if schedule.total is not None:
        text += f" ({in_all} in all)"
    return f"{text}, {waiting}"


class WaitingGoals:
    """The waiting goals of all groups, in the order of their arrival.

    Most have also begun to wait in that order. A goal that an earlier process has accepted may have
    waited for longer than those that are here already.
    """

    def __init__(self) -> None:
        self._entries: dict[GoalID, Entry] = {}
        self._by_time: list[tuple[float, int, Entry]] = []

    def __len__(self) -> int:
        return len(self._entries)

    def add(self, entry: Entry) -> None:
        """Add a goal, which waits from its `since` on."""
        self._entries[entry.goal_id] = entry
        if len(self._by_time) > 2 * len(self._entries) + 16:  # most are those that have left
            self._by_time = [_timed(one) for one in self._entries.values()]
            heapify(self._by_time)
        else:
            heappush(self._by_time, _timed(entry))

    def remove(self, goal_id: GoalID) -> None:
        """Remove a goal; if it does not wait, do nothing."""
        self._entries.pop(goal_id, None)

    def longest(self) -> Entry | None:
        """Return the goal that has waited longest; None if none waits."""
        while self._by_time:
            since, _, entry = self._by_time[0]
            # A goal that has started has another time, and one that was sent again another entry.
            if self._entries.get(entry.goal_id) is entry and entry.since == since:
                return entry
            heappop(self._by_time)
        return None

    def positions(self) -> dict[GoalID, tuple[int, int]]:
        """Return the place of each goal, from 1, and the number that wait for its key."""
        places: dict[GoalID, tuple[int, int]] = {}
        groups: dict[Hashable, list[Entry]] = {}
        for entry in self._entries.values():
            groups.setdefault(entry.group.key, []).append(entry)
        for entries in groups.values():
            # Successors are ahead of the queue.
            entries.sort(key=lambda one: (one.predecessor is None, one.urgency))
            for place, entry in enumerate(entries, 1):
                places[entry.goal_id] = (place, len(entries))
        return places


def _timed(entry: Entry) -> tuple[float, int, Entry]:
    return entry.since, entry.urgency[1], entry


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
        """Running goals that were told to take their successors over, since then."""
        self.interrupted: OrderedDict[GoalID, Entry] = OrderedDict()
        """Those that were interrupted, since then."""

    def restart(self, owner: object, now: float) -> None:
        """Let the goals of an owner begin only now."""
        for entry in [one for one in self.running.values() if one.owner is owner]:
            entry.since = now
            self.running.move_to_end(entry.goal_id)

    def tell(self, entry: Entry, now: float) -> Order:
        """Let a goal take its successor over, for a time."""
        self.told[entry.goal_id] = entry
        entry.told_at = now
        return entry.order(Act.TELL)

    def interrupt(self, entry: Entry, reason: str, now: float) -> Order:
        """Interrupt a goal that was not interrupted before."""
        del self.running[entry.goal_id]
        self.told.pop(entry.goal_id, None)
        self.interrupted[entry.goal_id] = entry
        entry.since = now
        return entry.order(Act.INTERRUPT, reason)

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
            return entry.order(Act.KILL)
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

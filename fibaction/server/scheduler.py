"""`Scheduler`: which accepted goals run, which wait, and which give way.

Theory of operation
-------------------

A `Schedule` is a server's setting, and a `Scheduler` carries it out. The scheduler is sans-I/O: it
is told of each goal that is offered (`offer`) and of each that has left (`leave`), and of the time
as `now`. It returns a list of `Order`s, which its caller carries out: start a goal, end a goal that
waits, interrupt or kill one that runs. It calls no executors and reads no clock.

Goals are grouped by key; without a key, all goals are one group. A group has `concurrency` places
for goals that run, and `queue` places for goals that wait. `total` limits the goals that run in all
groups together.

A goal that is offered starts if a place is free, and waits if the queue has room. Otherwise
`when_full` decides:

- `"reject"`: the goal is rejected.
- `"preempt"`: the goal becomes the *successor* of one that runs, its predecessor. The predecessor
  is interrupted, and its successor starts when it has left, ahead of the queue. A successor that
  has not started yet gives way to a newer one. With a priority, a goal preempts only goals that are
  less urgent.
- `"replace"`: the newest waiting goal gives way.

A place is free again only when its goal has left, so a successor never runs beside the clean-up of
its predecessor. A goal leaves once, whether it ended, was canceled while it waited, or was killed.

Waiting goals start in the order of their urgency, and of their arrival within. Each group has a
heap of its waiting goals. If `total` keeps several groups waiting, `_heads` orders them by their
first goals. Entries of heaps that are out of date are skipped when they come up, so every step
costs O(log n).
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from enum import Enum
from heapq import heapify, heappop, heappush
from typing import NamedTuple, TypeAlias

from fibaction.goals import GoalID
from fibaction.server.schedule import Schedule

_Urgency: TypeAlias = tuple[float, int]
"""The place of a goal in the order of those that wait: smaller is first, and no two are equal."""


class Act(Enum):
    """A kind of order."""

    START = "start"
    """Run the goal's executor."""
    END = "end"
    """End a goal that has not started, for the reason. It has left already."""
    INTERRUPT = "interrupt"
    """Interrupt the goal's executor for the reason; call `leave` when it has ended."""
    KILL = "kill"
    """Kill the goal's executor, which was interrupted and has not ended in time; call `leave`."""


class Order(NamedTuple):
    """One step that the caller of a scheduler carries out."""

    act: Act
    goal_id: GoalID
    reason: str = ""


class Busy(Exception):
    """A goal can neither run nor wait; the text says how many do."""


class _Entry:
    """A goal that runs or waits."""

    __slots__ = ("goal_id", "group", "predecessor", "since", "successor", "urgency")

    def __init__(self, goal_id: GoalID, group: _Group, urgency: _Urgency, now: float) -> None:
        self.goal_id = goal_id
        self.group = group
        self.urgency = urgency
        self.since = now
        """The time of its arrival, of its start, or of its interruption: the latest of them."""
        self.predecessor: _Entry | None = None
        """The goal that is interrupted for this one."""
        self.successor: _Entry | None = None
        """The goal that starts when this one has left."""


class _Group:
    """The goals of one key."""

    def __init__(self, key: Hashable) -> None:
        self.key = key
        self.running: dict[GoalID, _Entry] = {}  # in the order of their start
        self.queue: dict[GoalID, _Entry] = {}  # in the order of their arrival
        self.listed: _Urgency | None = None
        """The goal with which the group stands in the order of groups; None if it does not."""
        self._heap: list[tuple[_Urgency, _Entry]] = []

    def add(self, entry: _Entry) -> None:
        """Add a goal to the queue."""
        self.queue[entry.goal_id] = entry
        if len(self._heap) > 2 * len(self.queue) + 16:  # most are those of goals that have left
            self._heap = [(one.urgency, one) for one in self.queue.values()]
            heapify(self._heap)
        else:
            heappush(self._heap, (entry.urgency, entry))

    def first(self) -> _Entry | None:
        """Return the goal of the queue that starts next."""
        while self._heap and self._heap[0][1].goal_id not in self.queue:
            heappop(self._heap)
        return self._heap[0][1] if self._heap else None


class Scheduler:
    """The goals of one server that run and wait."""

    def __init__(self, schedule: Schedule, *, kill_after: float = math.inf) -> None:
        """Kill an interrupted executor that has not ended `kill_after` seconds later."""
        self._schedule = schedule
        self._kill_after = kill_after
        self._groups: dict[Hashable, _Group] = {}
        self._entries: dict[GoalID, _Entry] = {}
        self._arrivals = 0
        self._running = 0
        # In the order of their times, so that the first is due first.
        self._waiting: dict[GoalID, _Entry] = {}
        self._timed: dict[GoalID, _Entry] = {}  # they run, and are not interrupted
        self._interrupted: dict[GoalID, _Entry] = {}
        self._heads: list[tuple[_Urgency, _Group]] = []

    # Events

    def offer(
        self, goal_id: GoalID, *, key: Hashable = None, urgency: float = 0, now: float
    ) -> list[Order]:
        """Take a goal that was accepted: it runs, waits, or makes another one give way.

        Raises:
            Busy: It can do none of these, and was not taken.
        """
        group = self._groups.get(key) or _Group(key)
        self._arrivals += 1
        entry = _Entry(goal_id, group, (urgency, self._arrivals), now)
        orders: list[Order] = []
        if self._has_place(group):
            orders.append(self._start(entry, now))
        elif len(group.queue) < self._schedule.queue:
            self._wait(entry)
        elif self._schedule.when_full == "replace":
            newest = next(reversed(group.queue.values()))
            orders.append(self._give_way(newest, f"replaced by {goal_id}"))
            self._wait(entry)
        elif (predecessor := self._predecessor(entry)) is not None:
            orders += self._preempt(predecessor, entry, now)
        else:
            raise Busy(self._busy(group))
        self._groups[key] = group
        self._entries[goal_id] = entry
        return orders

    def leave(self, goal_id: GoalID, now: float) -> list[Order]:
        """Give back the place of a goal that has ended; of an unknown one, nothing."""
        entry = self._entries.get(goal_id)
        if entry is None:
            return []
        self._remove(entry)
        successor = entry.successor
        if successor is not None:
            successor.predecessor = None
            return [self._start(successor, now)]
        return self._start_waiting(now)

    def take_over(self, goal_id: GoalID, now: float) -> GoalID | None:
        """Let the successor of a goal take its place, and the goal leave; return the successor.

        Return None, and change nothing, if the goal has no successor.
        """
        entry = self._entries.get(goal_id)
        successor = entry and entry.successor
        if entry is None or successor is None:
            return None
        self._remove(entry)
        successor.predecessor = None
        self._start(successor, now)
        return successor.goal_id

    def due(self, now: float) -> list[Order]:
        """Return the orders that are due because time has passed."""
        rules, orders = self._schedule, []
        while (entry := _first(self._waiting)) and entry.since + rules.queue_timeout <= now:
            orders.append(self._give_way(entry, f"waited for {rules.queue_timeout:g} s"))
        while (entry := _first(self._timed)) and entry.since + rules.run_timeout <= now:
            orders.append(self._interrupt(entry, f"took longer than {rules.run_timeout:g} s", now))
        while (entry := _first(self._interrupted)) and entry.since + self._kill_after <= now:
            del self._interrupted[entry.goal_id]
            orders.append(Order(Act.KILL, entry.goal_id))
        return orders

    # Queries

    @property
    def next_due(self) -> float:
        """The time at which `due` has orders; `math.inf` if time alone makes none."""
        times = (
            (self._waiting, self._schedule.queue_timeout),
            (self._timed, self._schedule.run_timeout),
            (self._interrupted, self._kill_after),
        )
        return min(
            entry.since + seconds if (entry := _first(entries)) else math.inf
            for entries, seconds in times
        )

    def successor(self, goal_id: GoalID) -> GoalID | None:
        """Return the goal that starts when this one has left; None if none was preempting it."""
        entry = self._entries.get(goal_id)
        return entry.successor.goal_id if entry and entry.successor else None

    def places(self) -> dict[GoalID, tuple[int, int]]:
        """Return the place of each waiting goal, from 1, and the number that wait for its key."""
        places: dict[GoalID, tuple[int, int]] = {}
        groups: dict[Hashable, list[_Entry]] = {}
        for entry in self._waiting.values():
            groups.setdefault(entry.group.key, []).append(entry)
        for entries in groups.values():
            # Successors are ahead of the queue.
            entries.sort(key=lambda one: (one.predecessor is None, one.urgency))
            for place, entry in enumerate(entries, 1):
                places[entry.goal_id] = (place, len(entries))
        return places

    # Steps

    def _has_place(self, group: _Group) -> bool:
        concurrency, total = self._schedule.concurrency, self._schedule.total
        return (concurrency is None or len(group.running) < concurrency) and (
            total is None or self._running < total
        )

    def _start(self, entry: _Entry, now: float) -> Order:
        group = entry.group
        group.queue.pop(entry.goal_id, None)
        self._waiting.pop(entry.goal_id, None)
        group.running[entry.goal_id] = self._timed[entry.goal_id] = entry
        entry.since = now
        self._running += 1
        self._push_head(group)
        return Order(Act.START, entry.goal_id)

    def _wait(self, entry: _Entry) -> None:
        entry.group.add(entry)
        self._waiting[entry.goal_id] = entry
        self._push_head(entry.group)

    def _give_way(self, entry: _Entry, reason: str) -> Order:
        self._remove(entry)
        return Order(Act.END, entry.goal_id, reason)

    def _remove(self, entry: _Entry) -> None:
        goal_id, group = entry.goal_id, entry.group
        if group.running.pop(goal_id, None) is not None:
            self._running -= 1
        group.queue.pop(goal_id, None)
        for entries in (self._waiting, self._timed, self._interrupted, self._entries):
            entries.pop(goal_id, None)
        if entry.predecessor is not None:
            entry.predecessor.successor = None
        if group.running or group.queue:
            self._push_head(group)
        elif entry.successor is None:
            self._groups.pop(group.key, None)

    def _start_waiting(self, now: float) -> list[Order]:
        orders: list[Order] = []
        while self._heads:
            if self._schedule.total is not None and self._running >= self._schedule.total:
                break
            urgency, group = heappop(self._heads)
            if urgency != group.listed:
                continue  # another goal of the group came before it, and is listed
            group.listed = None
            first = group.first()
            if first is None or not self._has_place(group):
                continue  # it is listed again when a goal of the group arrives or leaves
            if first.urgency == urgency:
                orders.append(self._start(first, now))
            else:
                self._push_head(group)
        return orders

    def _push_head(self, group: _Group) -> None:
        """List the group by its first waiting goal, unless it is listed so."""
        first = group.first()
        if first is not None and first.urgency != group.listed:
            group.listed = first.urgency
            heappush(self._heads, (first.urgency, group))

    # Preempting

    def _predecessor(self, entry: _Entry) -> _Entry | None:
        """Return the goal that is to give way to a new one; None if none may."""
        if self._schedule.when_full != "preempt":
            return None
        running = entry.group.running.values()
        by_priority = self._schedule.priority is not None
        free = [one for one in running if one.successor is None]
        # With successors that may give way, if all that run have one.
        least = min(
            free or running,
            key=lambda one: (-(one.successor or one).urgency[0], (one.successor or one).urgency[1])
            if by_priority
            else one.urgency[1:],
            default=None,
        )
        if least is None or not by_priority:
            return least
        return least if entry.urgency[0] < (least.successor or least).urgency[0] else None

    def _preempt(self, predecessor: _Entry, entry: _Entry, now: float) -> list[Order]:
        reason = f"preempted by {entry.goal_id}"
        orders: list[Order] = []
        if predecessor.successor is not None:
            orders.append(self._give_way(predecessor.successor, reason))
        predecessor.successor, entry.predecessor = entry, predecessor
        self._waiting[entry.goal_id] = entry
        if predecessor.goal_id in self._timed:
            orders.append(self._interrupt(predecessor, reason, now))
        return orders

    def _interrupt(self, entry: _Entry, reason: str, now: float) -> Order:
        del self._timed[entry.goal_id]
        self._interrupted[entry.goal_id] = entry
        entry.since = now
        return Order(Act.INTERRUPT, entry.goal_id, reason)

    def _busy(self, group: _Group) -> str:
        limits = self._schedule
        limit = limits.total if limits.concurrency is None else limits.concurrency
        text = f"busy: {len(group.running)} of {limit} running"
        if limits.total is not None and limits.concurrency is not None:
            text += f" ({self._running} of {limits.total} in all)"
        return f"{text}, {len(group.queue)} of {limits.queue} waiting"


def _first(entries: dict[GoalID, _Entry]) -> _Entry | None:
    return next(iter(entries.values()), None)

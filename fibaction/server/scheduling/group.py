"""The goals of one key, as the scheduler keeps them: `Group`, and its `Entry`s."""

from __future__ import annotations

from collections.abc import Hashable
from heapq import heapify, heappop, heappush
from typing import TypeAlias

from fibaction.server.scheduling.schedule import Schedule
from fibaction.words.goals import GoalID

Urgency: TypeAlias = tuple[float, int]
"""The place of a goal in the order of those that wait: smaller is first, and no two are equal."""


class Entry:
    """A goal that runs or waits."""

    __slots__ = (
        "expires",
        "goal_id",
        "group",
        "predecessor",
        "since",
        "successor",
        "told_at",
        "urgency",
    )

    def __init__(
        self, goal_id: GoalID, group: Group, urgency: Urgency, now: float, expires: float
    ) -> None:
        self.goal_id = goal_id
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

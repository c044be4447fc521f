"""`FleetScheduler`: a scheduler whose goals also need a slot that servers elsewhere may take.

Theory of operation
-------------------

With a `fleet_limit`, the goals of a key that run are counted at all workers of a fleet. So a goal
never starts at once: it waits, and the scheduler asks for a slot of its key (`KeySlots`). When
the slot is granted, the goal starts that comes first by then. When it has left, its slot is given
back, and the next goal needs another one: between two goals of a worker, others have their turn.

A slot is asked for only if the goal could start here. Until it is granted, it counts as if the
goal ran, for `concurrency` and `total`. So a granted slot is used at once, and no worker holds a
slot of the fleet while it waits for something of its own. That order, first here and then in the
fleet, is the same at all workers: so they cannot wait for each other in a circle.

The slots are told two numbers for each key: the goals that run, and those asked for. Each event
ends with them (`_note`). A slot that is granted, and that no goal needs any longer, is given back
by that.

A goal gives way to no other one that runs: with a `fleet_limit`, no schedule preempts.
"""

from __future__ import annotations

import math
from heapq import heappop
from typing import Any

import msgspec

from fibaction._runtime.text import excerpt
from fibaction.border.goal_store import KeySlots
from fibaction.server.scheduling.schedule import Schedule
from fibaction.server.scheduling.scheduled_goals import Act, Entry, Group, Order
from fibaction.server.scheduling.scheduler import Scheduler

NO_KEY = b""
"""The key of all goals of a schedule without keys, in the fleet."""


class FleetScheduler(Scheduler):
    """The goals of one worker that run and wait. Their keys are `portable`; None is the key of all
    goals of a schedule without keys.
    """

    def __init__(
        self, schedule: Schedule, slots: KeySlots, *, kill_after: float = math.inf
    ) -> None:
        """Start goals by slots of the fleet."""
        super().__init__(schedule, kill_after=kill_after)
        self.key_slots = slots
        self._asked = 0

    def granted(self, key: bytes, now: float) -> list[Order]:
        """Start a goal of a key, which has a slot now; if none waits any longer, do nothing."""
        group = self._groups.get(key or None)
        if group is None or not group.asked:
            return []
        self._asked -= 1
        group.asked -= 1
        orders: list[Order] = []
        while (first := group.first()) is not None:
            orders.append(self._turn(first, now))
            if orders[-1].act is Act.START:
                break
        self._note(group)
        return orders + self._start_waiting(now)

    def due(self, now: float, limit: int | None = None) -> list[Order]:
        orders = super().due(now, limit)
        return orders + self._start_waiting(now)

    def capacity(self) -> tuple[float, float]:
        running, waiting = super().capacity()
        return max(running - self._asked, 0), waiting

    # Steps

    def _has_capacity(self, group: Group) -> bool:
        """Return False: each goal waits first."""
        return False

    def _wait(self, entry: Entry) -> None:
        super()._wait(entry)
        self._start_waiting(entry.since)

    def _remove(self, entry: Entry) -> None:
        super()._remove(entry)
        self._note(entry.group)

    def _start_waiting(self, now: float) -> list[Order]:
        """Ask for slots for the goals that come first, and start none of them yet."""
        total = self._schedule.total
        while self._heads and (total is None or self._running + self._asked < total):
            urgency, group = heappop(self._heads)
            if urgency != group.listed:
                continue  # another goal of the group came before it, and is listed
            group.listed = None
            if self._may_ask(group):
                group.asked += 1
                self._asked += 1
                self._note(group)
                self._push_head(group)
        return []

    def _may_ask(self, group: Group) -> bool:
        concurrency = self._schedule.concurrency
        assert concurrency is not None
        wanted = len(group.running) + group.asked
        return group.asked < len(group.queue) and wanted < concurrency

    def _note(self, group: Group) -> None:
        """Tell the slots what a group has and needs, after a goal has started or left."""
        surplus = max(group.asked - len(group.queue), 0)
        group.asked -= surplus
        self._asked -= surplus
        assert isinstance(group.key, bytes | None)
        self.key_slots.note(group.key or NO_KEY, len(group.running), group.asked)


def portable(key: Any) -> bytes:
    """Return a key as bytes, which are the same in each process, and not empty.

    Raises:
        TypeError, ValueError: It cannot be, or it is not equal to itself.
    """
    if isinstance(key, float) and math.isnan(key):
        raise ValueError("it returned nan, which is not equal to itself")
    try:
        return msgspec.msgpack.encode(key, order="deterministic")
    except (TypeError, ValueError, OverflowError) as exc:
        raise TypeError(
            f"it returned {excerpt(repr(key))}, and a key for a fleet is a text, a number, or a"
            f" tuple of them"
        ) from exc

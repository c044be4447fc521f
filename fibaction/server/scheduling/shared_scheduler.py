"""`SharedScheduler`: the scheduler of all servers that were given the same schedule.

Theory of operation
-------------------

Servers that have the same `Schedule` object share its limits, as long as they run: two actions of
one arm, for example. Mostly it is one server. Each has a dispatcher, which `join`s and `quit`s, and
which owns its goals at the scheduler. The orders of the scheduler may concern goals of any of them,
so `carry_out` gives each to the owner of its goal.

With a `fleet_limit`, the scheduler is a `FleetScheduler`, by the slots of this worker's store.

Any of the dispatchers may keep the time. All of them wait for the same `news`, so those that are
left still do when one quits.

With a `fleet_limit`, the goals of a key that run are counted at all workers of a fleet. So a goal
never starts at once: it waits, and the scheduler asks for a slot of its key (`KeySlots`). When the
slot is granted, the goal starts that comes first by then. When it has left, its slot is given back,
and the next goal needs another one: between two goals of a worker, others have their turn.

A slot is asked for only if the goal could start here. Until it is granted, it counts as if the goal
ran, for `concurrency` and `total`. So a granted slot is used at once, and no worker holds a slot of
the fleet while it waits for something of its own. That order, first here and then in the fleet, is
the same at all workers: so they cannot wait for each other in a circle.

The slots are told two numbers for each key: the goals that run, and those asked for. Each event
ends with them (`_note`). A slot that is granted, and that no goal needs any longer, is given back
by that. A goal gives way to no other one that runs: with a `fleet_limit`, no schedule preempts.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable
from heapq import heappop
from typing import Any, Protocol
from weakref import WeakValueDictionary

import msgspec
from anyio import current_time

from fibaction._runtime.notify import Notifier
from fibaction._runtime.text import excerpt
from fibaction.border.goal_store import KeySlots
from fibaction.server.scheduling.schedule import Schedule
from fibaction.server.scheduling.scheduled_goals import Act, Entry, Group, Order
from fibaction.server.scheduling.scheduler import Scheduler
from fibaction.words.goals import GoalID

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


class Member(Protocol):
    """A dispatcher that shares a scheduler."""

    kill_after: float

    def carry_out(self, order: Order) -> None:
        """Carry out an order for a goal of this member."""

    def note_change(self) -> None:
        """Note that a goal has left the schedule."""


class SharedScheduler:
    """The scheduler of one schedule, and the members that own its goals."""

    def __init__(self, schedule: Schedule, kill_after: float, slots: KeySlots | None) -> None:
        self.scheduler: Scheduler
        """The rules, which know the goals of all members."""
        self.news = Notifier()
        """The signal that an order is due earlier than `wake_at`."""
        self.wake_at = 0.0
        self._schedule = schedule  # so that its ID is not that of another one meanwhile
        self._kill_after = kill_after
        self._slots = slots
        self._thread = threading.get_ident()
        self._members: list[Member] = []
        if slots is None:
            self.scheduler = Scheduler(schedule, kill_after=kill_after)
        else:
            fleet = self.scheduler = FleetScheduler(schedule, slots, kill_after=kill_after)
            slots.open(lambda key: self.carry_out(fleet.granted(key, current_time())))

    @classmethod
    def join(
        cls, schedule: Schedule, member: Member, slots: KeySlots | None = None
    ) -> SharedScheduler:
        """Let a member use the scheduler of a schedule object from now on, and return it. The first
        one makes it; `slots` are those of the fleet, with a `fleet_limit`.

        Raises:
            ValueError: The member kills executors after another time than those that are there, or
                is of another worker.
            RuntimeError: Those that are there run in another thread.
        """
        shared = _shared.get(id(schedule))
        if shared is None or not shared._members:
            shared = _shared[id(schedule)] = cls(schedule, member.kill_after, slots)
        if shared._kill_after != member.kill_after:
            raise ValueError(
                f"servers that share a schedule have the same shutdown_timeout, not"
                f" {shared._kill_after:g} and {member.kill_after:g}"
            )
        if shared._thread != threading.get_ident():
            raise RuntimeError(
                "a server in another thread has the same Schedule object, and cannot share its"
                " limits: give each thread a Schedule of its own"
            )
        if shared._slots is not slots:
            raise ValueError(
                f"servers that share a schedule with fleet_limit={schedule.fleet_limit!r} are"
                f" served by one worker: give each worker a Schedule of its own"
            )
        shared._members.append(member)
        return shared

    def quit(self, member: Member, now: float) -> None:
        """Remove the goals that a member still has, and let it use the scheduler no longer."""
        for goal_id in self.scheduler.goals_of(member):
            self.leave(member, goal_id, now)
        self._members.remove(member)
        if self._slots is not None and not self._members:
            self._slots.close()

    def leave(self, member: Member, goal_id: GoalID, now: float) -> None:
        """Remove a goal, unless the member has no such goal here."""
        self.carry_out(self.scheduler.leave(goal_id, now, member))
        for one in tuple(self._members):
            one.note_change()

    def carry_out(self, orders: Iterable[Order]) -> None:
        """Let the owners of the goals carry out orders."""
        for order in orders:
            order.owner.carry_out(order)
        if self.scheduler.next_due < self.wake_at:
            self.news.notify()


_shared: WeakValueDictionary[int, SharedScheduler] = WeakValueDictionary()

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
"""

from __future__ import annotations

import threading
from collections.abc import Iterable
from typing import Protocol
from weakref import WeakValueDictionary

from anyio import current_time

from fibaction._runtime.notify import Notifier
from fibaction.border.goal_store import KeySlots
from fibaction.server.scheduling.fleet_scheduler import FleetScheduler
from fibaction.server.scheduling.schedule import Schedule
from fibaction.server.scheduling.scheduled_goals import Order
from fibaction.server.scheduling.scheduler import Scheduler
from fibaction.words.goals import GoalID


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

"""`SharedScheduler`: the scheduler of all servers that were given the same schedule.

Theory of operation
-------------------

Servers that have the same `Schedule` object share its places, as long as they run: two actions of
one arm, for example. Mostly it is one server. Each has a dispatcher, which `join`s and `quit`s, and
which owns its goals here, from `offer` or `restore` to `leave` or `forget`. The orders of the
scheduler may concern goals of any of them, so `carry_out` gives each to the owner of its goal.

Any of the dispatchers may keep the time. All of them wait for the same `news`, so those that are
left still do when one quits.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable
from typing import Any, Protocol, Self
from weakref import WeakValueDictionary

from fibaction._runtime.notify import Notifier
from fibaction.server.scheduling.orders import Busy, Order
from fibaction.server.scheduling.schedule import Schedule
from fibaction.server.scheduling.scheduler import Scheduler
from fibaction.words.goals import GoalID


class Member(Protocol):
    """A dispatcher that shares a scheduler."""

    kill_after: float

    def carry_out(self, order: Order) -> None:
        """Carry out an order for a goal of this member."""

    def note_change(self) -> None:
        """Note that a place has become free."""


class SharedScheduler:
    """The scheduler of one schedule, and the members that own its goals."""

    def __init__(self, schedule: Schedule, kill_after: float) -> None:
        self.scheduler = Scheduler(schedule, kill_after=kill_after)
        self.news = Notifier()
        """The signal that an order is due earlier than `wake_at`."""
        self.wake_at = 0.0
        self._schedule = schedule  # so that its ID is not that of another one meanwhile
        self._kill_after = kill_after
        self._thread = threading.get_ident()
        self._members: list[Member] = []
        self._owners: dict[GoalID, Member] = {}

    @classmethod
    def join(cls, schedule: Schedule, member: Member, *parts: Any) -> Self:
        """Let a member use the scheduler of a schedule object from now on, and return it. The first
        one makes it, with these other parts.

        Raises:
            ValueError: The member kills executors after another time than those that are there.
            RuntimeError: Those that are there run in another thread.
        """
        shared = _shared.get(id(schedule))
        if shared is None or not shared._members:
            shared = _shared[id(schedule)] = cls(schedule, member.kill_after, *parts)
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
        assert isinstance(shared, cls)
        shared._members.append(member)
        return shared

    def quit(self, member: Member, now: float) -> None:
        """Free the places that a member still has, and let it use the scheduler no longer."""
        for goal_id in [one for one, owner in self._owners.items() if owner is member]:
            self.leave(member, goal_id, now)
        self._members.remove(member)

    def offer(self, member: Member, goal_id: GoalID, **terms: Any) -> list[Order]:
        """Take a goal of a member: see `Scheduler.offer`.

        Raises:
            Busy: It can neither run nor wait, or another member has a goal of the same ID.
        """
        self._check_is_free(goal_id, member)
        orders = self.scheduler.offer(goal_id, **terms)
        self._owners[goal_id] = member
        return orders

    def restore(self, member: Member, goal_id: GoalID, **terms: Any) -> list[Order]:
        """Take a goal of a member that an earlier process has accepted: see `Scheduler.restore`.

        Raises:
            Busy: Another member has a goal of the same ID.
        """
        self._check_is_free(goal_id, member)
        self._owners[goal_id] = member
        return self.scheduler.restore(goal_id, **terms)

    def _check_is_free(self, goal_id: GoalID, member: Member) -> None:
        if self._owners.get(goal_id, member) is not member:
            raise Busy("busy: another action of the same schedule has a goal of this ID")

    @property
    def is_empty(self) -> bool:
        """True if no member uses it any longer."""
        return not self._members

    def owns(self, member: Member, goal_id: GoalID) -> bool:
        """Return whether a goal here belongs to that member."""
        return self._owners.get(goal_id) is member

    def leave(self, member: Member, goal_id: GoalID, now: float) -> None:
        """Free the place of a goal, unless the member has no such goal here."""
        if self.owns(member, goal_id):
            orders = self.scheduler.leave(goal_id, now)
            del self._owners[goal_id]
            self.carry_out(orders)
        for one in tuple(self._members):
            one.note_change()

    def forget(self, goal_id: GoalID) -> None:
        """Forget the owner of a goal that has no place any more: it was ended before its turn, or
        its successor has taken its place. Such a goal does not `leave`.
        """
        self._owners.pop(goal_id, None)

    def carry_out(self, orders: Iterable[Order]) -> None:
        """Let the owners of the goals carry out orders."""
        for order in orders:
            owner = self._owners.get(order.goal_id)
            if owner is not None:
                owner.carry_out(order)
        if self.scheduler.next_due < self.wake_at:
            self.news.notify()


_shared: WeakValueDictionary[int, SharedScheduler] = WeakValueDictionary()

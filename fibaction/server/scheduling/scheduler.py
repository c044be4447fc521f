"""`Scheduler`: the order in which accepted goals run, wait and give way.

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
  is interrupted, and its successor starts when it has left, or another goal of its group, ahead of
  the queue. A successor that has not started yet gives way to a newer one, and goes back into the
  queue if there is room. With a priority, a goal preempts only goals that are less urgent, and does
  not wait before.
- `"replace"`: the newest waiting goal gives way.

With `handover`, a predecessor is told of its successor first (`Act.TELL`), and interrupted only
later. Meanwhile it can take its successor over (`take_over`): it leaves, and its executor and its
place are the successor's. If the successor gives way or is canceled, the predecessor just
continues.

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
from heapq import heapify, heappop, heappush

from fibaction.server.scheduling.schedule import Schedule
from fibaction.server.scheduling.scheduled_goals import (
    Act,
    Busy,
    Entry,
    Group,
    Order,
    TimedGoals,
    Urgency,
    WaitingGoals,
    busy_text,
)
from fibaction.words.goals import GoalID

EXPIRED = "its client's timeout was over before its turn came"
"""The reason of a goal that is skipped."""


class Scheduler:
    """The goals of one server that run and wait."""

    def __init__(self, schedule: Schedule, *, kill_after: float = math.inf) -> None:
        """Kill an interrupted executor that has not ended `kill_after` seconds later."""
        self._schedule = schedule
        self._overdue = f"waited for {schedule.queue_timeout:g} s"
        self._groups: dict[Hashable, Group] = {}
        self._entries: dict[GoalID, Entry] = {}
        self._arrivals = 0
        self._running = 0
        self._waiting = WaitingGoals()
        self._timed = TimedGoals(schedule, kill_after)
        self._heads: list[tuple[Urgency, Group]] = []

    # Events

    def offer(
        self,
        goal_id: GoalID,
        *,
        key: Hashable = None,
        urgency: float = 0,
        now: float,
        expires: float = math.inf,
        owner: object = None,
    ) -> list[Order]:
        """Take a goal that was accepted: it runs, waits, or makes another one give way. If it has
        no turn before it `expires`, it ends instead. The `owner` carries out the orders for it.

        Raises:
            Busy: It can do none of these, and was not taken; or another owner has a goal of the
                same ID.
        """
        self._check_is_free(goal_id, owner)
        if goal_id in self._entries:
            raise Busy(f"busy: an earlier goal {goal_id} was killed, and has not ended yet")
        group = self._groups.get(key) or Group(key)
        self._arrivals += 1
        entry = Entry(goal_id, group, (urgency, self._arrivals), now, expires, owner)
        orders: list[Order] = []
        has_room = len(group.queue) < self._schedule.queue
        if self._has_capacity(group):
            orders.append(self._start(entry, now))
        elif (predecessor := self._predecessor(entry, has_room=has_room)) is not None:
            orders += self._preempt(predecessor, entry, now)
        elif has_room:
            self._wait(entry)
        elif self._schedule.when_full == "replace":
            newest = next(reversed(group.queue.values()))
            orders.append(self._give_way(newest, f"replaced by {goal_id}"))
            self._wait(entry)
        else:
            raise Busy(busy_text(self._schedule, group, self._running))
        self._groups[key] = group
        self._entries[goal_id] = entry
        return orders

    def restore(
        self,
        goal_id: GoalID,
        *,
        key: Hashable = None,
        urgency: float = 0,
        now: float,
        waited: float = 0.0,
        expires: float = math.inf,
        owner: object = None,
    ) -> list[Order]:
        """Take a goal that has `waited` in an earlier process: it runs, waits, or ends by that.

        Raises:
            Busy: Another owner has a goal of the same ID.
        """
        self._check_is_free(goal_id, owner)
        if waited >= self._schedule.queue_timeout:
            return [Order(Act.END, goal_id, self._overdue, owner)]
        if expires <= now:
            return [Order(Act.END, goal_id, EXPIRED, owner)]
        group = self._groups.setdefault(key, Group(key))
        self._arrivals += 1
        rank = urgency, self._arrivals
        entry = Entry(goal_id, group, rank, now - waited, expires, owner)
        self._entries[goal_id] = entry
        if self._has_capacity(group):
            return [self._start(entry, now)]
        self._wait(entry)
        return []

    def _check_is_free(self, goal_id: GoalID, owner: object) -> None:
        known = self._entries.get(goal_id)
        if known is not None and known.owner is not owner:
            raise Busy("busy: another action of the same schedule has a goal of this ID")

    def leave(self, goal_id: GoalID, now: float, owner: object = None) -> list[Order]:
        """Give back the place of a goal of an owner that has ended; of an unknown one, nothing."""
        entry = self._entries.get(goal_id)
        if entry is None or entry.owner is not owner:
            return []
        self._remove(entry)
        successor = entry.successor
        if successor is None and self._schedule.when_full == "preempt":
            # That of another goal need not wait for the end of just this one.
            successor = entry.group.next_successor()
        if successor is None or not self._has_capacity(entry.group):
            return self._start_waiting(now)
        self._unlink(successor)
        order = self._turn(successor, now)
        return [order] if order.act is Act.START else [order, *self._start_waiting(now)]

    def lose(self, goal_id: GoalID) -> None:
        """Order nothing more for a goal that runs. It keeps its place until it leaves."""
        self._timed.remove(goal_id)

    def go_on(self, goal_id: GoalID, now: float) -> list[Order]:
        """Take a goal that was lost as one that starts now; an unknown one changes nothing."""
        entry = self._entries.get(goal_id)
        if entry is None or goal_id not in entry.group.running:
            return []
        entry.since = now
        self._timed.running[goal_id] = entry
        successor = entry.successor
        if successor is None:
            return []
        return [self._timed.interrupt(entry, f"preempted by {successor.goal_id}", now)]

    def take_over(self, goal_id: GoalID, now: float) -> GoalID | None:
        """Let the successor of a goal take its place, and the goal leave; return the successor.

        Return None, and change nothing, if the goal has none that it may take over.
        """
        entry = self._timed.told.get(goal_id)
        if entry is None:
            return None
        successor = entry.successor
        assert successor is not None
        self._remove(entry)
        self._unlink(successor)
        self._start(successor, now)
        return successor.goal_id

    def restart(self, owner: object, now: float) -> None:
        """Let the goals of an owner that have a place to run begin only now."""
        self._timed.restart(owner, now)

    def due(self, now: float, limit: int | None = None) -> list[Order]:
        """Return orders that are due because time has passed, at most `limit`."""
        orders: list[Order] = []
        while len(orders) != limit and (order := self._next_order(now)) is not None:
            orders.append(order)
        return orders

    def _next_order(self, now: float) -> Order | None:
        timeout = self._schedule.queue_timeout
        if (entry := self._waiting.longest()) and entry.since + timeout <= now:
            return self._give_way(entry, self._overdue)
        return self._timed.next_order(now)

    # Queries

    @property
    def next_due(self) -> float:
        """The time at which `due` has orders; `math.inf` if time alone makes none."""
        due, timeout = self._timed.next_due(), self._schedule.queue_timeout
        if timeout < math.inf and (entry := self._waiting.longest()):
            due = min(due, entry.since + timeout)
        return due

    @property
    def waiting(self) -> int:
        """The number of goals that wait."""
        return len(self._waiting)

    def capacity(self) -> tuple[float, float]:
        """Return how many more goals can run now, and how many more can wait; `math.inf` if there
        is no limit, or if it depends on the goal.
        """
        rules = self._schedule
        running = math.inf if rules.total is None else rules.total - self._running
        # With keys there are any number of queues; otherwise a new goal makes another give way.
        waiting = math.inf if rules.queue or rules.when_full == "preempt" else 0.0
        if rules.key is None:
            group = self._groups.get(None)
            started, queued = (len(group.running), len(group.queue)) if group else (0, 0)
            if rules.concurrency is not None:
                running = min(running, rules.concurrency - started)
            if rules.when_full == "reject":
                waiting = rules.queue - queued
        return max(running, 0), max(waiting, 0)

    def successor(self, goal_id: GoalID) -> GoalID | None:
        """Return the goal that this one may take over; None if there is none."""
        entry = self._timed.told.get(goal_id)
        if entry is None or entry.successor is None or entry.successor.owner is not entry.owner:
            return None  # an executor is not made for the goals of another owner
        return entry.successor.goal_id

    def goals_of(self, owner: object) -> list[GoalID]:
        """Return the goals of an owner."""
        return [goal_id for goal_id, entry in self._entries.items() if entry.owner is owner]

    def positions(self) -> dict[GoalID, tuple[int, int]]:
        """Return the place of each waiting goal, from 1, and the number that wait for its key."""
        return self._waiting.positions()

    # Steps

    def _has_capacity(self, group: Group) -> bool:
        concurrency, total = self._schedule.concurrency, self._schedule.total
        return (concurrency is None or len(group.running) < concurrency) and (
            total is None or self._running < total
        )

    def _turn(self, entry: Entry, now: float) -> Order:
        """Start a goal that has waited, or end it if it has expired."""
        return self._give_way(entry, EXPIRED) if entry.expires <= now else self._start(entry, now)

    def _start(self, entry: Entry, now: float) -> Order:
        group = entry.group
        group.queue.pop(entry.goal_id, None)
        self._waiting.remove(entry.goal_id)
        group.running[entry.goal_id] = self._timed.running[entry.goal_id] = entry
        entry.since = now
        self._running += 1
        self._push_head(group)
        return entry.order(Act.START)

    def _wait(self, entry: Entry) -> None:
        entry.group.add(entry)
        self._waiting.add(entry)
        self._push_head(entry.group)

    def _give_way(self, entry: Entry, reason: str) -> Order:
        self._remove(entry)
        return entry.order(Act.END, reason)

    def _remove(self, entry: Entry) -> None:
        goal_id, group = entry.goal_id, entry.group
        del self._entries[goal_id]
        if group.running.pop(goal_id, None) is not None:
            self._running -= 1
            self._timed.remove(goal_id)
        else:
            self._waiting.remove(goal_id)
            group.queue.pop(goal_id, None)  # a successor is not in it
        self._unlink(entry)
        if group.running or group.queue:
            self._push_head(group)
        elif entry.successor is None:
            self._groups.pop(group.key, None)
            group.listed = None

    def _unlink(self, entry: Entry) -> None:
        """Make a goal no successor any more; its predecessor continues unless interrupted."""
        if entry.predecessor is not None:
            entry.predecessor.successor = None
            self._timed.told.pop(entry.predecessor.goal_id, None)
            entry.predecessor = None

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
            if first is None or not self._has_capacity(group):
                continue  # it is listed again when a goal of the group arrives or leaves
            orders.append(self._turn(first, now))
        return orders

    def _push_head(self, group: Group) -> None:
        """List the group by its first waiting goal, unless it is listed so."""
        first = group.first()
        if first is None or first.urgency == group.listed:
            return
        group.listed = first.urgency
        heappush(self._heads, (first.urgency, group))
        if len(self._heads) > 2 * len(self._groups) + 16:  # most are out of date
            self._heads = [head for head in self._heads if head[1].listed == head[0]]
            heapify(self._heads)

    # Preempting

    def _predecessor(self, entry: Entry, *, has_room: bool) -> Entry | None:
        """Return the goal that is to give way to a new one; None if none may."""
        by_priority = self._schedule.priority is not None
        if self._schedule.when_full != "preempt" or (has_room and not by_priority):
            return None
        if not by_priority:
            return entry.group.oldest()
        least = entry.group.least_urgent()
        if least is None or entry.urgency[0] >= least.last.urgency[0]:
            return None
        return least

    def _preempt(self, predecessor: Entry, entry: Entry, now: float) -> list[Order]:
        reason = f"preempted by {entry.goal_id}"
        orders: list[Order] = []
        earlier = predecessor.successor
        predecessor.successor, entry.predecessor = entry, predecessor
        if earlier is not None:
            earlier.predecessor = None
            if len(entry.group.queue) < self._schedule.queue:
                self._wait(earlier)
            else:
                orders.append(self._give_way(earlier, reason))
        self._waiting.add(entry)
        timed = self._timed
        if predecessor.goal_id not in timed.running or predecessor.goal_id in timed.told:
            return orders  # it was interrupted, or told, because of an earlier goal
        if self._schedule.handover:
            orders.append(timed.tell(predecessor, now))
        else:
            orders.append(timed.interrupt(predecessor, reason, now))
        return orders

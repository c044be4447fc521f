"""The places of goals in a server's schedule, and the rules for them, as a plain model.

It is told of each goal that is offered, begins, is interrupted, is taken over and leaves. It keeps
lists of its own, and never asks the product's scheduler.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from fibaction import GoalID, GoalStatus
from tests.simulation.facts import EPSILON, Life, Truth, short
from tests.simulation.scenario import SchedulePlan, Work

if TYPE_CHECKING:
    from tests.simulation.invariants import Record

LATE = 0.25
"""Seconds that an order of the schedule may be late: executors that never await take turns."""
BY_SERVER = ("preempted by ", "replaced by ", "waited for ", "took longer than ")
"""The beginnings of the reasons for which a schedule ends goals."""


class Places:
    """The goals of each server that run and wait."""

    def __init__(self, record: Record) -> None:
        self._record = record
        self.plan = record.scenario.server.schedule or SchedulePlan()
        self._offered: dict[GoalID, Work] = {}
        self.counts = dict.fromkeys(("waited", "busy", "taken over", "killed", *BY_SERVER), 0)
        """The number of events of each kind."""

    def _fail(self, rule: str, truth: Truth, text: str) -> None:
        self._record.fail(rule, f"goal {short(truth.goal_id)} {text}")

    # Queries

    def _key(self, truth: Truth) -> int:
        return self.plan.key_of(truth.work)

    def _urgency(self, truth: Truth) -> int:
        return self.plan.urgency_of(truth.work)

    def _running(self, life: Life, key: int) -> list[Truth]:
        return [one for one in life.running if self._key(one) == key]

    def _queue(self, life: Life, key: int) -> list[Truth]:
        """Return the goals of a key that wait, without successors of others."""
        successors = life.successors.values()
        return [one for one in life.waiting if self._key(one) == key and one not in successors]

    def _has_capacity(self, life: Life, key: int) -> bool:
        concurrency, total = self.plan.concurrency, self.plan.total
        return (concurrency is None or len(self._running(life, key)) < concurrency) and (
            total is None or len(life.running) < total
        )

    def _predecessor(self, life: Life, key: int, urgency: int) -> Truth | None:
        """Return the goal that has to give way to a new one that has no place."""
        by_priority = self.plan.urgencies > 0
        has_room = len(self._queue(life, key)) < self.plan.queue
        if self.plan.when_full != "preempt" or (has_room and not by_priority):
            return None
        running = self._running(life, key)
        free = [one for one in running if one not in life.successors]
        last = {one: life.successors.get(one, one) for one in running}
        if not running:
            return None
        if not by_priority:
            return free[0] if free else min(running, key=lambda one: last[one].arrival)
        least = max(free or running, key=lambda one: (self._urgency(last[one]), -last[one].arrival))
        return least if urgency < self._urgency(last[least]) else None

    # Events

    def offered(self, life: Life, goal_id: GoalID, work: Work) -> None:
        """Note a goal that looks for a place."""
        self.check(life)
        self._offered[goal_id] = work

    def rejected(self, life: Life, goal_id: GoalID, reason: str) -> None:
        """Check that a goal was rejected because no place is free, with the right numbers."""
        plan, work = self.plan, self._offered[goal_id]
        self.counts["busy"] += 1
        if "was killed" in reason:
            known = any(one.goal_id == goal_id and one.outcome for one in life.running)
            if not known:
                self._record.fail("place", f"no goal was killed, but: {reason}")
            return
        key = plan.key_of(work)
        at_key, waiting = len(self._running(life, key)), len(self._queue(life, key))
        in_all = f"{len(life.running)} of {plan.total}"
        text = f"busy: {in_all} running"
        if plan.concurrency is not None:
            text = f"busy: {at_key} of {plan.concurrency} running"
            text += "" if plan.total is None else f" ({in_all} in all)"
        if reason != f"{text}, {waiting} of {plan.queue} waiting":
            self._record.fail("place", f"rejected as {reason!r}, and not {text}, {waiting} waiting")
        may_wait = waiting < plan.queue or plan.when_full == "replace"
        if (
            may_wait
            or self._has_capacity(life, key)
            or self._predecessor(life, key, plan.urgency_of(work))
        ):
            self._record.fail("place", f"rejected as {reason!r}, and has a place")

    def accepted(self, truth: Truth) -> None:
        """Note the place of a goal that was accepted."""
        life = truth.life
        truth.work = self._offered.pop(truth.goal_id, truth.work)
        truth.arrival = len(life.goals)
        key = self._key(truth)
        life.latest = truth
        if not self._has_capacity(life, key):
            self.counts["waited"] += 1
            predecessor = self._predecessor(life, key, self._urgency(truth))
            if predecessor is not None:
                life.successors[predecessor] = truth
                predecessor.told_at = min(predecessor.told_at, self._record.now())
        life.waiting.append(truth)

    def begun(self, truth: Truth) -> None:
        """Check the goal to which a place was given."""
        life = truth.life
        if truth not in life.waiting or truth.statuses[-1] is not GoalStatus.ACCEPTED:
            self._fail("turn", truth, f"begins, and is {truth.statuses[-1].name}")
            return
        life.waiting.remove(truth)
        if not self._has_capacity(life, self._key(truth)):
            others = [short(one.goal_id) for one in life.running]
            self._fail("place", truth, f"begins beside {others}, beyond the limit")
        if truth in life.successors.values():
            self._fail("turn", truth, "begins before its predecessor has left")
        elif truth is not life.next:
            self._check_turn(truth)
        life.next = None
        life.running.append(truth)
        truth.began_at = self._record.now()

    def _check_turn(self, truth: Truth) -> None:
        """Check that no other goal had to begin before."""
        mine = (self._urgency(truth), truth.arrival)
        for key in {self._key(one) for one in truth.life.waiting}:
            for other in self._queue(truth.life, key):
                is_first = (self._urgency(other), other.arrival) < mine
                if is_first and self._has_capacity(truth.life, key):
                    self._fail("turn", truth, f"begins before {short(other.goal_id)}")

    def started(self, truth: Truth) -> None:
        """Check that an executor that starts has a place."""
        if truth not in truth.life.running or truth.statuses[-1] is not GoalStatus.EXECUTING:
            self._fail("turn", truth, f"runs, and is {truth.statuses[-1].name}")

    def interrupted(self, truth: Truth, reason: str) -> None:
        """Check a goal that the server ends for this reason."""
        life, now = truth.life, self._record.now()
        truth.stop_reason = truth.stop_reason or reason
        words = next((words for words in BY_SERVER if reason.startswith(words)), "")
        if not words:
            return
        self.counts[words] += 1
        is_waiting = truth in life.waiting
        since, seconds = truth.accepted_at, 0.0
        if words == "waited for ":
            is_right, seconds = is_waiting, self.plan.queue_timeout
        elif words == "took longer than ":
            is_right, since, seconds = not is_waiting, truth.began_at, self.plan.run_timeout
        elif is_waiting:
            is_right, since = self._gives_way_rightly(truth, words, reason), now
        else:
            successor = life.successors.get(truth)
            is_right = successor is not None and reason == f"preempted by {successor.goal_id}"
            since, seconds = truth.told_at, self.plan.handover
        if not is_right:
            self._fail("turn", truth, f"gives way wrongly: {reason}")
        if not -EPSILON <= now - since - seconds <= LATE:
            self._fail("turn", truth, f"gives way after {now - since:g} s: {reason}")
        truth.interrupted_at = min(truth.interrupted_at, now)

    def _gives_way_rightly(self, truth: Truth, words: str, reason: str) -> bool:
        """Return whether a waiting goal has to give way to the one that came last."""
        life, newer = truth.life, truth.life.latest
        if newer is None or reason != f"{words}{newer.goal_id}":
            return False
        queue = [one for one in self._queue(life, self._key(newer)) if one is not newer]
        if words == "replaced by ":
            return self.plan.when_full == "replace" and queue[-1:] == [truth]
        # It was a successor, in whose place the newer one is now.
        others = [one for one in queue if one is not truth]
        return newer in life.successors.values() and len(others) >= self.plan.queue

    def killed(self, truth: Truth) -> None:
        """Check that the clean-up of a goal that is killed has had its time."""
        self.counts["killed"] += 1
        had = self._record.now() - truth.interrupted_at
        if not -EPSILON <= had - self._record.scenario.server.shutdown_timeout <= LATE:
            self._fail("turn", truth, f"is killed {had:g} s after its interruption")

    def taken_over(self, truth: Truth, successor: Truth) -> None:
        """Check that a goal which was not interrupted is taken over, and by the right one."""
        life = truth.life
        self.counts["taken over"] += 1
        truth.stop_reason = f"preempted by {successor.goal_id}"
        if life.successors.pop(truth, None) is not successor or truth.interrupted_at < math.inf:
            self._fail("turn", truth, f"takes {short(successor.goal_id)} over")
        if successor in life.waiting:
            life.waiting.remove(successor)
        if truth in life.running:
            life.running.remove(truth)
        life.running.append(successor)
        successor.began_at = self._record.now()

    def ended(self, truth: Truth) -> None:
        """Check the reason for which a goal has ended."""
        outcome, life = truth.outcome, truth.life
        assert outcome is not None
        if truth.starts == 0 and outcome.status is GoalStatus.SUCCEEDED:
            self._fail("turn", truth, "has succeeded, and never ran")
        is_servers = outcome.reason.startswith(BY_SERVER) or truth.starts == 0
        if outcome.status is GoalStatus.ABORTED and is_servers:
            if outcome.reason != truth.stop_reason:
                self._fail("turn", truth, f"ends as {outcome.reason!r}, not {truth.stop_reason!r}")
        elif truth.starts == 0 and outcome.reason:
            self._fail("turn", truth, f"was canceled, and ends as {outcome.reason!r}")
        if truth in life.waiting:
            life.waiting.remove(truth)
            for predecessor, successor in tuple(life.successors.items()):
                if successor is truth:
                    del life.successors[predecessor]
                    predecessor.told_at = math.inf

    def left(self, truth: Truth) -> None:
        """Note that the executor of a goal is gone, and with it the goal's place."""
        life = truth.life
        if truth in life.running:
            life.running.remove(truth)
            life.next = life.successors.pop(truth, None) or self._next_successor(truth)

    def _next_successor(self, truth: Truth) -> Truth | None:
        """Return the successor of another goal that gets the place of this one."""
        life, key = truth.life, self._key(truth)
        able = {one: of for of, one in life.successors.items() if self._key(one) == key}
        if not able or not self._has_capacity(life, key):
            return None
        first = min(able, key=lambda one: (self._urgency(one), one.arrival))
        predecessor = able[first]
        del life.successors[predecessor]
        predecessor.told_at = math.inf
        return first

    # At any time

    def check(self, life: Life) -> None:
        """Check that nothing waits that has to begin, has waited too long, or was canceled."""
        if life.stops_at <= self._record.now():
            return
        plan, now = self.plan, self._record.now()
        for truth in life.waiting:
            is_successor = truth in life.successors.values()
            if self._has_capacity(life, self._key(truth)) and not is_successor:
                self._fail("place", truth, "waits beside a free place")
            if truth.statuses[-1] is not GoalStatus.ACCEPTED:
                self._fail("turn", truth, f"waits, and is {truth.statuses[-1].name}")
            if now > truth.accepted_at + plan.queue_timeout + LATE:
                self._fail("turn", truth, "waits for too long")
        for truth in life.running:
            due = truth.began_at + plan.run_timeout
            if truth in life.successors:
                due = min(due, truth.told_at + plan.handover)
            if now > due + LATE and truth.interrupted_at == math.inf:
                self._fail("turn", truth, "runs for too long")
            due = truth.interrupted_at + self._record.scenario.server.shutdown_timeout
            if now > due + LATE and truth.outcome is None:
                self._fail("turn", truth, "cleans up for too long")


def _check_nothing(*_: Any, **__: Any) -> None:
    """Do nothing."""


class NoPlaces(Places):
    """The places of goals whose rules are not checked: a store delays what a schedule orders."""

    offered = accepted = begun = started = _check_nothing
    killed = taken_over = ended = left = check = _check_nothing

    def rejected(self, life: Life, goal_id: GoalID, reason: str) -> None:
        """Count the rejection."""
        self.counts["busy"] += 1

    def interrupted(self, truth: Truth, reason: str) -> None:
        """Note why the server ends a goal."""
        truth.stop_reason = truth.stop_reason or reason

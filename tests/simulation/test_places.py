"""Each thing that a schedule must not do is found."""

from __future__ import annotations

from typing import Any

from fibaction import GoalID, GoalStatus, Outcome
from fibaction.words.statuses import INITIAL
from tests.simulation.facts import Life, Truth
from tests.simulation.invariants import Record
from tests.simulation.places import Places
from tests.simulation.scenario import Scenario, SchedulePlan, ServerPlan, Work

ABORTED, CANCELED, SUCCEEDED = GoalStatus.ABORTED, GoalStatus.CANCELED, GoalStatus.SUCCEEDED


class Known:
    """A record of one server, with goals that are told by their numbers."""

    def __init__(self, **rules: Any) -> None:
        self.now = 10.0
        server = ServerPlan(schedule=SchedulePlan(**rules), shutdown_timeout=5.0)
        self.record = Record(Scenario(0, "calm", server, ()), lambda: self.now)
        self.places: Places = self.record.places
        self.life = Life(1, 0.0, lambda _: False)
        self.record.lives.append(self.life)
        self.record.may_cancel(None)

    def found(self) -> list[str]:
        """Return the invariants that do not hold."""
        return [violation.invariant for violation in self.record.violations]

    def goal_id(self, number: int) -> GoalID:
        return GoalID(number.to_bytes(16, "big"))

    def accept(self, number: int) -> Truth:
        self.places.offered(self.life, self.goal_id(number), Work(number))
        self.record.accepted(self.life, self.goal_id(number), number)
        return self.life.goals[self.goal_id(number), number]

    def begin(self, truth: Truth) -> Truth:
        self.places.begun(truth)
        self.record.changed(truth, GoalStatus.EXECUTING)
        self.record.started(truth)
        return truth

    def end(self, truth: Truth, status: GoalStatus = ABORTED, reason: str = "") -> None:
        if status is CANCELED:
            self.record.changed(truth, GoalStatus.CANCELING)
        elif truth.statuses[-1] is INITIAL:
            self.record.changed(truth, GoalStatus.EXECUTING)
        self.record.changed(truth, status)
        self.record.ended(truth, Outcome(status, None, reason), truth.count)

    def run(self, number: int) -> Truth:
        return self.begin(self.accept(number))


def test_a_goal_that_runs_or_begins_though_it_must_not_is_found() -> None:
    known = Known(concurrency=1, queue=1)
    first, second = known.run(1), known.accept(2)
    known.record.started(second)
    assert known.found() == ["turn"]
    known.places.begun(first)
    assert known.found() == ["turn"] * 2


def test_a_goal_that_is_preempted_by_another_than_its_successor_is_found() -> None:
    known = Known(concurrency=2, when_full="preempt")
    first, second = known.run(1), known.run(2)
    third = known.accept(3)
    known.places.interrupted(second, f"preempted by {third.goal_id}")
    assert known.found() == ["turn", "turn"]  # it has no successor, and so no time of it
    known.places.interrupted(first, f"preempted by {third.goal_id}")
    assert known.found() == ["turn", "turn"]


def test_a_goal_that_waits_runs_or_cleans_up_for_too_long_is_found() -> None:
    known = Known(concurrency=1, queue=1, queue_timeout=3.0, run_timeout=5.0)
    first, _ = known.run(1), known.accept(2)
    known.now += 6
    known.places.check(known.life)
    assert known.found() == ["turn"] * 2
    first.interrupted_at = known.now
    known.now += 6
    known.places.check(known.life)
    assert known.found() == ["turn"] * 4


def test_a_goal_that_is_killed_too_early_is_found() -> None:
    known = Known(concurrency=1, run_timeout=5.0)
    first = known.run(1)
    first.interrupted_at = known.now
    known.now += 5
    known.places.killed(first)
    assert known.found() == []
    known.now -= 1
    known.places.killed(first)
    assert known.found() == ["turn"]


def test_a_rejection_without_need_or_with_other_numbers_is_found() -> None:
    known = Known(concurrency=1, total=3, queue=1)
    known.run(1)

    def reject(reason: str) -> None:
        known.places.offered(known.life, known.goal_id(9), Work(9))
        known.places.rejected(known.life, known.goal_id(9), reason)

    reject("busy: 1 of 1 running (1 of 3 in all), 0 of 1 waiting")
    assert known.found() == ["place"]
    known.accept(2)
    reject("busy: 1 of 1 running (1 of 3 in all), 1 of 1 waiting")
    assert known.found() == ["place"]
    reject("busy: 1 of 1 running (2 of 3 in all), 1 of 1 waiting")
    assert known.found() == ["place"] * 2
    reject("busy: an earlier goal 9 was killed, and has not ended yet")
    assert known.found() == ["place"] * 3

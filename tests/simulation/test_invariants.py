"""Each thing that must not be is found."""

from __future__ import annotations

from fibaction import (
    GoalID,
    GoalInfo,
    GoalStatus,
    Outcome,
    Sender,
    UnknownGoal,
)
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.server.registry.registry import GoalRegistry
from fibaction.words.goals import digest_of
from tests.simulation.facts import Life, Truth
from tests.simulation.generator import scenario_of
from tests.simulation.invariants import Record
from tests.simulation.scenario import Step
from tests.simulation.views import View, Watch

GOAL = GoalID(b"a goal of a test")


class Known:
    """A record that knows one goal, of one server, sent by one client."""

    def __init__(self, seed: int = 0) -> None:
        self.now = 10.0
        self.record = Record(scenario_of(seed), lambda: self.now)
        registry = GoalRegistry()
        self.life = Life(1, 0.0, lambda part: part is registry)
        self.record.lives.append(self.life)
        self.client = self.record.clients["client-0"]
        self.client.goals.add(GOAL)
        self.record.accepted(self.life, GOAL, 1)
        self.truth = self.life.goals[GOAL, 1]
        self.record.places.begun(self.truth)
        self.truth.starts = 1
        self.view = View(self.record, self.client, GOAL, 1, start=0)

    def found(self) -> list[str]:
        """The invariants that do not hold."""
        return [violation.invariant for violation in self.record.violations]

    def ends(self, *statuses: GoalStatus) -> None:
        for status in statuses:
            self.record.changed(self.truth, status)
        self.record.ended(self.truth, Outcome(statuses[-1]), self.truth.count)


def test_a_gap_that_nobody_has_told_is_found() -> None:
    known = Known()
    known.truth.count = 5
    known.view.feedback(Step(1), 0)
    known.view.feedback(Step(3), 1)
    assert known.found() == []
    known.view.feedback(Step(5), 1)
    assert known.found() == ["feedback"]


def test_feedback_of_a_goal_may_be_read_after_a_copy_of_it_was_restored() -> None:
    # The server that has accepted the copy has failed before it could tell that.
    known = Known()
    known.truth.count = 2
    known.view = View(known.record, known.client, GOAL, None, start=0)
    known.record.copied.add(GOAL)
    known.record.lives.append(Life(2, known.now, lambda _: False))
    copy = GoalRecord(GOAL, digest_of(b""), 2, Sender())
    known.record.restored(known.record.lives[1], copy)
    known.record.lives[1].goals[GOAL, 2].starts = 1
    known.view.feedback(Step(1), None)
    known.view.feedback(Step(2), None)
    assert known.found() == []


def test_a_server_may_have_forgotten_what_the_next_one_restores() -> None:
    known = Known()
    known.ends(GoalStatus.EXECUTING, GoalStatus.ABORTED)
    known.now += 1
    life = Life(2, known.now, known.life.owns)
    known.record.lives.append(life)
    truth = life.goals[GOAL, 1] = Truth(GOAL, 1, life, known.truth.accepted_at, "")
    truth.outcome, truth.ended_at, truth.is_restored = Outcome(GoalStatus.ABORTED), 10.0, True
    known.record.failed(known.client, UnknownGoal(GOAL), "follow", GOAL, since=known.now - 0.1)
    assert known.found() == []
    known.record.failed(known.client, UnknownGoal(GOAL), "follow", GOAL, since=known.now + 0.1)
    assert known.found() == ["error"]


def test_a_watcher_who_misses_a_status_is_found() -> None:
    known = Known()
    known.ends(GoalStatus.EXECUTING, GoalStatus.ABORTED)
    watch = Watch(known.record, known.client, exact=True)
    watch.info(GoalInfo(GOAL, 1, GoalStatus.ACCEPTED), is_known=False)
    watch.info(GoalInfo(GOAL, 1, GoalStatus.ABORTED), is_known=False)
    watch.feedback(GOAL, 1, Step(1))
    assert known.found() == ["status", "feedback"]

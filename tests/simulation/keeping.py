"""The rules of a server with a store, as a plain model of what was kept and what was told.

`Keeping` is told of each write that the store has answered, of each goal that it gives to the next
server, of each fact that a server tells a client, of each start of an executor, and of each
checkpoint. A write counts from its answer on: before, and if it has failed, nothing may be told.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from fibaction import GoalHandle, GoalID, GoalStatus, Outcome
from fibaction.border.goal_store import StoredGoal
from tests.simulation.facts import Life, Truth, short
from tests.simulation.loop import EPOCH, PAST
from tests.simulation.scenario import ON_PURPOSE, SIMULATED, StorePlan, Work

if TYPE_CHECKING:
    from tests.simulation.invariants import Record

RESTARTED = "the server was restarted"
GIVEN_UP = "given up after "
STOPPED = "server stopped"


class Fact:
    """A goal whose acceptance is kept."""

    def __init__(self, goal: StoredGoal) -> None:
        self.goal_id = GoalID(goal.goal_id)
        self.stored = goal
        """The goal as the store has it."""
        self._checkpoint = goal.checkpoint  # the server changes the goal that it was given
        self.begun = 0
        """The last attempt whose executor has started."""
        self.lost: set[int] = set()
        """The attempts that were running when their process was gone."""
        self.lost_since = 0
        """The number of them since the last new checkpoint."""
        self.returned: int | None = None
        """The last checkpoint that has returned."""
        self.told: Outcome[bytes] | None = None
        """The outcome that clients were told."""
        self.is_cancel_told = False

    def store(self, goal: StoredGoal) -> None:
        """Note what the store has."""
        if goal.status.is_active and goal.checkpoint != self._checkpoint:
            self.lost_since = 0
        self.stored, self._checkpoint = goal, goal.checkpoint

    @property
    def outcome(self) -> Outcome[bytes] | None:
        """The outcome that is kept."""
        stored = self.stored
        if stored.status.is_active:
            return None
        return stored.outcome


class Keeping:
    """The goals of a store, and what clients and executors know of them."""

    def __init__(self, record: Record) -> None:
        self._record = record
        self._plan = record.scenario.server.store or StorePlan()
        self._facts: dict[tuple[GoalID, int], Fact] = {}
        self.counts: Counter[str] = Counter()
        """The number of checks of each kind."""

    def _fail(self, goal_id: GoalID, text: str) -> None:
        self._record.fail("keep", f"goal {short(goal_id)} {text}")

    def _fact(self, truth: Truth) -> Fact | None:
        return self._facts.get((truth.goal_id, truth.stamp))

    # The store

    def kept(self, what: str, goal: StoredGoal) -> None:
        """Note a write that is about to be answered."""
        self._record.tell(f"the store keeps: {what} {short(GoalID(goal.goal_id))}")
        key = GoalID(goal.goal_id), goal.stamp
        if what == "accept":
            self._facts[key] = Fact(goal)
        self._facts[key].store(goal)

    def claimed(self, goal: StoredGoal) -> None:
        """Check a goal that the next server gets."""
        fact = self._facts.setdefault((GoalID(goal.goal_id), goal.stamp), Fact(goal))
        fact.store(goal)
        if goal.status.is_terminal:
            return
        self.counts["goals found active"] += 1
        is_lost = goal.is_running and goal.attempt not in fact.lost  # since the last start
        if is_lost:
            fact.lost.add(goal.attempt)
            fact.lost_since += 1
        before = self._record.lives[-2:-1]
        is_late = max(self._plan.delays) > self._record.scenario.server.shutdown_timeout
        if before and before[0].is_orderly and not is_late:
            self.counts["goals found after a stop"] += 1
            if self._plan.at_stop == "abort" or is_lost:
                self._fail(fact.goal_id, f"was left by a server that was stopped: {goal}")
        if fact.told is not None:
            self._fail(fact.goal_id, f"was told as {fact.told}, and is active after a restart")
        if fact.is_cancel_told and goal.status is not GoalStatus.CANCELING:
            self._fail(fact.goal_id, "was told as canceling, and its cancel is forgotten")

    def forgotten(self, goal: StoredGoal) -> None:
        """Note the outcome of a goal that is not kept any longer."""
        fact = self._facts.get((GoalID(goal.goal_id), goal.stamp))
        if fact is not None:  # else its process has died before the acceptance was answered
            fact.store(goal)

    def ended_at(self, truth: Truth) -> float:
        """Return the time of the end of a goal that was found in the store."""
        fact = self._fact(truth)
        assert fact is not None
        return (fact.stored.ended_at - PAST) / 1e9 - EPOCH

    def is_active(self, goal_id: GoalID, stamp: int | None) -> bool:
        """Return whether a goal is kept, and is active."""
        return any(
            fact.outcome is None
            for key, fact in self._facts.items()
            if key[0] == goal_id and stamp in (None, key[1])
        )

    # The server

    def accepted(self, goal_id: GoalID, stamp: int) -> None:
        """Check that a goal that is accepted is not kept already."""
        if self._record.scenario.server.store is None:
            return
        server, now = self._record.scenario.server, self._record.now()
        for (known, known_stamp), fact in self._facts.items():
            if known != goal_id or known_stamp == stamp:
                continue
            ended_at = (fact.stored.ended_at - PAST) / 1e9 - EPOCH
            later = sum(one.stored.ended_at > fact.stored.ended_at for one in self._facts.values())
            is_expired = now >= ended_at + server.result_timeout or later >= server.max_results
            if fact.outcome is None or not is_expired:
                self._fail(goal_id, "was accepted again, and is kept")

    def started(self, truth: Truth, goal: GoalHandle[Work]) -> None:
        """Check the start of an executor."""
        if self._record.scenario.server.store is None or truth.life.is_dead:
            return
        self.counts["starts"] += 1
        fact = self._fact(truth)
        if fact is None:
            self._fail(truth.goal_id, "runs, and its acceptance is not kept")
            return
        stored = fact.stored
        if fact.outcome is not None:
            self._fail(truth.goal_id, f"runs, and has ended as {fact.outcome}")
        elif stored.status is GoalStatus.CANCELING:
            self._fail(truth.goal_id, "runs, and its cancel was accepted")
        elif not stored.is_running or stored.attempt != goal.attempt:
            self._fail(truth.goal_id, f"runs, and attempt {goal.attempt} is not kept: {stored}")
        if goal.attempt <= fact.begun:
            self._fail(truth.goal_id, f"begins attempt {goal.attempt} after {fact.begun}")
        fact.begun = goal.attempt
        self._check_restored(fact, goal)
        if fact.lost:
            self.counts["starts after a crash"] += 1
            self._check_recovery(fact, goal.request)

    def _check_restored(self, fact: Fact, goal: GoalHandle[Work]) -> None:
        state = fact.stored.checkpoint
        assert SIMULATED.checkpoint is not None
        kept = None if state is None else SIMULATED.checkpoint.decode(state)
        if goal.restored != kept:
            self._fail(fact.goal_id, f"begins with {goal.restored}, and {kept} is kept")
        if fact.returned is not None:
            self.counts["restored checkpoints"] += 1
            if goal.restored is None or goal.restored < fact.returned:
                self._fail(fact.goal_id, f"begins with {goal.restored}, not {fact.returned}")

    def _check_recovery(self, fact: Fact, work: Work) -> None:
        """Check that a goal whose attempts were lost may run again."""
        recovery, lost = self._plan.recovery, fact.lost_since
        if recovery == "abort" or (recovery != "rerun" and work.key % 3 == 0):
            self._fail(fact.goal_id, f"runs again, and the recovery is {recovery}")
        if lost >= self._plan.max_attempts:
            self._fail(fact.goal_id, f"runs again after {lost} attempts were lost")

    def ended(self, truth: Truth) -> None:
        """Check that a goal that is to be kept is not ended by a stop."""
        assert truth.outcome is not None
        was_canceled = GoalStatus.CANCELING in truth.statuses
        if truth.outcome.reason == STOPPED and self._plan.at_stop == "keep" and not was_canceled:
            self._fail(truth.goal_id, "is ended by a stop, and not kept")

    def ended_by_recovery(self, truth: Truth) -> None:
        """Check the end of a goal that was found active, and was not run."""
        fact, outcome = self._fact(truth), truth.outcome
        assert fact is not None
        assert outcome is not None
        self.counts["ends at a restart"] += 1
        given_up = outcome.reason.startswith(GIVEN_UP)
        if outcome.status is GoalStatus.SUCCEEDED:
            self._fail(truth.goal_id, "has succeeded, and did not run")
        elif outcome.status is GoalStatus.ABORTED:
            by_rule = outcome.reason == RESTARTED or ON_PURPOSE in outcome.reason
            if (by_rule or given_up) and not fact.lost:
                self._fail(truth.goal_id, f"was not running, and ends: {outcome.reason}")
            if given_up and fact.lost_since < self._plan.max_attempts:
                self._fail(truth.goal_id, f"was lost {fact.lost_since} times, and is given up")
            if outcome.reason == RESTARTED and self._plan.recovery != "abort":
                self._fail(truth.goal_id, f"is not run again: {outcome.reason}")

    def checkpoint_returned(self, truth: Truth, state: int) -> None:
        """Check a checkpoint that has returned."""
        if self._record.scenario.server.store is None or truth.life.is_dead:
            return
        fact = self._fact(truth)
        assert fact is not None
        assert SIMULATED.checkpoint is not None
        self.counts["checkpoints"] += 1
        kept = fact.stored.checkpoint
        if fact.outcome is None and (kept is None or SIMULATED.checkpoint.decode(kept) < state):
            self._fail(truth.goal_id, f"has got its checkpoint {state}, and {kept!r} is kept")
        fact.returned = max(state, fact.returned or 0)

    # The clients

    def told(
        self,
        life: Life,
        goal_id: GoalID,
        stamp: int,
        status: GoalStatus,
        outcome: Outcome[bytes] | None = None,
    ) -> None:
        """Check what a client is told of a goal."""
        if life.is_dead or status is GoalStatus.UNKNOWN:
            return
        self.counts["told"] += 1
        fact = self._facts.get((goal_id, stamp))
        if fact is None:
            self._fail(goal_id, f"is told as {status.name}, and its acceptance is not kept")
            return
        if status is GoalStatus.CANCELING:
            self.counts["cancels told"] += 1
            fact.is_cancel_told = True
            if fact.stored.status is not GoalStatus.CANCELING and fact.outcome is None:
                self._fail(goal_id, "is told as canceling, and that is not kept")
        elif status.is_terminal:
            self.counts["ends told"] += 1
            self._check_end(fact, status, outcome)

    def _check_end(self, fact: Fact, status: GoalStatus, outcome: Outcome[bytes] | None) -> None:
        kept = fact.outcome
        if kept is None or kept.status is not status or outcome not in (None, kept):
            self._fail(fact.goal_id, f"is told as {outcome or status.name}, and {kept} is kept")
        if fact.told is not None and kept != fact.told:
            self._fail(fact.goal_id, f"is told as {kept}, and was told as {fact.told} before")
        fact.told = kept

    def told_feedback(self, life: Life, goal_id: GoalID, stamp: int, attempt: int) -> None:
        """Check an attempt whose feedback a client is told."""
        fact = self._facts.get((goal_id, stamp))
        if fact is not None and not life.is_dead and fact.stored.attempt < attempt:
            self._fail(goal_id, f"has told feedback of attempt {attempt}, which is not kept")

    # The end

    def over(self) -> None:
        """Check that no goal is forgotten."""
        for fact in self._facts.values():
            if fact.outcome is None:
                self._fail(fact.goal_id, f"has not ended: {fact.stored}")

"""Deliberate mistakes in the keeping of goals, beside those of `faults`."""

from __future__ import annotations

import math
from typing import Any
from unittest.mock import patch

from msgspec.structs import replace

from fibaction.border.goal_store import StoredGoal
from fibaction.server.cancels import Cancels
from fibaction.server.durability.goal_keeper import GoalKeeper
from fibaction.server.durability.keeper import Keeper
from fibaction.server.durability.recovery import Recovery
from fibaction.server.durability.stored_goals import LostAttempts
from fibaction.server.execution import runs
from fibaction.server.execution.executor import AnyRun
from fibaction.server.execution.runs import Runs
from fibaction.server.life import Event
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.server.registry.registry import GoalRegistry
from fibaction.words.goals import GoalID, Outcome
from fibaction.words.statuses import GoalStatus
from tests.simulation.faults import making, mistake

AnyRecovery = Recovery[Any, Any, Any]
AnyLostAttempts = LostAttempts[Any, Any, Any]
AnyRuns = Runs[Any, Any, Any]


def _tell_nothing(*_: object) -> None:
    """Do nothing when a write is kept: it was told before."""


def _tell_at_once(write: Any) -> Any:
    """Return a write that tells what it says as soon as it is handed to the store."""
    real = GoalKeeper._write

    def at_once(self: GoalKeeper, *args: Any) -> None:
        told: list[Any] = []

        def _write(
            keeper: GoalKeeper, method: Any, goal: Any, stored: Any, then: Any, *_: Any
        ) -> int:
            told.append(then)
            return real(keeper, method, goal, stored, _tell_nothing, _tell_nothing)

        with patch.object(GoalKeeper, "_write", _write):
            write(self, *args)
        for then in told:
            then()

    return at_once


# Told before it is kept


@making(GoalKeeper, "_write_acceptance", 1, 18, 25)
def an_acceptance_is_told_before_it_is_kept(real: Any) -> Any:
    """Accept a goal as soon as its acceptance is handed to the store."""
    return _tell_at_once(real)


@making(GoalKeeper, "_write_end", 20, 18, 25)
def an_end_is_told_before_it_is_kept(real: Any) -> Any:
    """Tell the outcome as soon as it is handed to the store."""
    return _tell_at_once(real)


@making(GoalKeeper, "_write_cancel", 20, 26, 28)
def a_cancel_is_told_before_it_is_kept(real: Any) -> Any:
    """Tell followers CANCELING as soon as it is handed to the store."""
    return _tell_at_once(real)


@mistake(Cancels, "__init__", 28, 26, 18)
def a_cancel_is_answered_before_it_is_kept(
    real: Any, self: Cancels[Any, Any, Any], *args: Any, **keywords: Any
) -> Any:
    """Do not wait for the store before a cancel is answered."""
    real(self, *args, **keywords)
    self._keeper = Keeper("")


@making(GoalKeeper, "_write_begin", 28, 26, 25)
def an_executor_starts_before_its_attempt_is_kept(real: Any) -> Any:
    """Start an executor as soon as its begin is handed to the store."""
    return _tell_at_once(real)


@mistake(GoalKeeper, "kept", 26, 18, 25)
async def a_checkpoint_returns_before_it_is_kept(_real: Any, self: GoalKeeper, write: int) -> Any:
    """Do not wait for the store in `checkpoint`."""
    if self._answered < write - 1:
        await self._wait(write - 1)


@mistake(GoalKeeper, "_fail", 20, 25, 41)
def a_failed_write_is_taken_for_kept(_real: Any, self: GoalKeeper, error: Any) -> Any:
    """Go on when a write has failed, as if it had not."""
    self._answers[0][1] and self._answers[0][1]()


# Forgotten


@mistake(GoalKeeper, "_write_cancel", 20, 26, 18)
def a_cancel_is_not_written(_real: Any, self: GoalKeeper, run: AnyRun) -> Any:
    """Accept a cancel, and keep it nowhere."""
    self.life.step(run, Event.CANCEL_KEPT)


@mistake(GoalKeeper, "_note_end", 33, 18, 25)
def the_result_is_not_written(
    real: Any, self: GoalKeeper, stored: StoredGoal, goal: GoalRecord, outcome: Outcome[bytes]
) -> Any:
    """Keep the end of a goal without its result."""
    real(self, stored, goal, replace(outcome, result=None))


@mistake(Recovery, "claim", 26, 40, 41)
def goals_that_waited_are_forgotten(real: Any, self: AnyRecovery, stored: StoredGoal) -> Any:
    """Take over only goals that were running."""
    if stored.is_running or stored.status.is_terminal:
        real(self, stored)


@mistake(Recovery, "claim", 25, 68)
def outcomes_are_forgotten(real: Any, self: AnyRecovery, stored: StoredGoal) -> Any:
    """Take over only goals that are active."""
    if stored.status.is_active:
        real(self, stored)


# Recovered wrongly


@mistake(Recovery, "claim", 67, 41)
def a_cancel_is_forgotten_at_a_restart(real: Any, self: AnyRecovery, stored: StoredGoal) -> Any:
    """Run goals again whose cancel was accepted."""
    if stored.status is GoalStatus.CANCELING:
        stored.status = GoalStatus.EXECUTING
    real(self, stored)


@mistake(Keeper, "restored", 47, 52, 54)
def no_checkpoint_is_restored(_real: Any, self: Keeper, stored: StoredGoal) -> Any:
    """Begin each attempt from nothing."""
    return None


@mistake(GoalKeeper, "checkpoint", 26, 33, 25)
def only_the_first_checkpoint_is_kept(
    real: Any, self: GoalKeeper, goal: GoalRecord, state: bytes
) -> Any:
    """Write the first checkpoint of a goal again instead of a later one."""
    assert goal.stored is not None
    return real(self, goal, goal.stored.checkpoint or state)


@mistake(LostAttempts, "reason_to_end", 20, 33, 54)
def a_goal_is_never_given_up(real: Any, self: AnyLostAttempts, stored: StoredGoal) -> Any:
    """Run a goal again however often its process has died."""
    self._max_attempts = 10**9
    return real(self, stored)


@mistake(LostAttempts, "reason_to_end", 1, 20, 25)
def a_goal_runs_again_whatever_the_recovery_says(
    _real: Any, self: AnyLostAttempts, stored: StoredGoal
) -> Any:
    """Do not ask what is to become of a goal that was running."""
    return ""


@mistake(Recovery, "claim", 67)
def a_goal_that_waited_counts_as_lost(real: Any, self: AnyRecovery, stored: StoredGoal) -> Any:
    """Treat goals that had not begun as if their attempt was lost."""
    stored.is_running = stored.status.is_active
    real(self, stored)


@mistake(Runs, "begin", 28, 40, 41)
def an_attempt_has_the_number_of_the_one_before(real: Any, self: AnyRuns, goal_id: GoalID) -> Any:
    """Do not count attempts."""
    if (run := self._runs.get(goal_id)) is not None:
        run.goal.attempt = 1
    real(self, goal_id)


@mistake(GoalRegistry, "restore", 18, 1, 20)
def a_restored_goal_has_another_stamp(
    real: Any, self: GoalRegistry, stored: StoredGoal, **keywords: Any
) -> Any:
    """Give goals a new stamp at each restart, so that they look like others to their clients."""
    stored.stamp += 1
    return real(self, stored, **keywords)


@mistake(GoalRegistry, "restore", 20, 25, 33)
def the_outcome_of_a_restored_goal_expires_at_once(
    real: Any, self: GoalRegistry, stored: StoredGoal, *, until: float = 0.0, **keywords: Any
) -> Any:
    """Count the result timeout from an end at the restart on, though the client is away."""
    return real(self, stored, until=-math.inf, **keywords)


# At a stop


@mistake(runs, "is_kept", 192, 52)
def a_goal_that_is_kept_is_told_as_aborted(_real: Any, *_: Any, **_keywords: Any) -> Any:
    """End goals at a planned restart that are to be kept."""
    return False


@mistake(GoalKeeper, "_write_release", 192, 52)
def a_goal_that_is_kept_is_not_released(_real: Any, self: GoalKeeper, run: AnyRun) -> Any:
    """Leave goals that are kept at a planned restart as running."""

"""Deliberate mistakes in the keeping of goals, beside those of `faults`."""

from __future__ import annotations

import math
from typing import Any
from unittest.mock import patch

from msgspec.structs import replace

from fibaction.border.goal_store import StoredGoal
from fibaction.server.cancels import Cancels
from fibaction.server.durability.goal_keeper import GoalKeeper
from fibaction.server.durability.keeper import Checkpoints, Keeper
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
from tests.simulation.faults import mistake

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


@mistake(GoalKeeper, "_write_acceptance", 1, 18, 25)
def an_acceptance_is_told_before_it_is_kept(real: Any) -> Any:
    """Accept a goal as soon as its acceptance is handed to the store."""
    return _tell_at_once(real)


@mistake(GoalKeeper, "_write_end", 20, 18, 25)
def an_end_is_told_before_it_is_kept(real: Any) -> Any:
    """Tell the outcome as soon as it is handed to the store."""
    return _tell_at_once(real)


@mistake(GoalKeeper, "_write_cancel", 20, 26, 28)
def a_cancel_is_told_before_it_is_kept(real: Any) -> Any:
    """Tell followers CANCELING as soon as it is handed to the store."""
    return _tell_at_once(real)


@mistake(Cancels, "__init__", 28, 26, 18)
def a_cancel_is_answered_before_it_is_kept(real: Any) -> Any:
    """Do not wait for the store before a cancel is answered."""

    def __init__(self: Cancels[Any, Any, Any], *args: Any, **keywords: Any) -> None:
        real(self, *args, **keywords)
        self._keeper = Keeper("")

    return __init__


@mistake(GoalKeeper, "_write_begin", 28, 26, 25)
def an_executor_starts_before_its_attempt_is_kept(real: Any) -> Any:
    """Start an executor as soon as its begin is handed to the store."""
    return _tell_at_once(real)


@mistake(GoalKeeper, "kept", 26, 18, 25)
def a_checkpoint_returns_before_it_is_kept(_real: Any) -> Any:
    """Do not wait for the store in `checkpoint`."""

    async def kept(self: GoalKeeper, write: int) -> None:
        if self._answered < write - 1:
            await self._wait(write - 1)

    return kept


@mistake(GoalKeeper, "_fail", 20, 25, 41)
def a_failed_write_is_taken_for_kept(_real: Any) -> Any:
    """Go on when a write has failed, as if it had not."""

    def _fail(self: GoalKeeper, error: Any) -> None:
        self._answers[0][1] and self._answers[0][1]()

    return _fail


# Forgotten


@mistake(GoalKeeper, "_write_cancel", 20, 26, 18)
def a_cancel_is_not_written(_real: Any) -> Any:
    """Accept a cancel, and keep it nowhere."""

    def _write_cancel(self: GoalKeeper, run: AnyRun) -> None:
        self.life.step(run, Event.CANCEL_KEPT)

    return _write_cancel


@mistake(GoalKeeper, "_note_end", 33, 18, 25)
def the_result_is_not_written(real: Any) -> Any:
    """Keep the end of a goal without its result."""

    def _note_end(
        self: GoalKeeper, stored: StoredGoal, goal: GoalRecord, outcome: Outcome[bytes]
    ) -> None:
        real(self, stored, goal, replace(outcome, result=None))

    return _note_end


@mistake(Recovery, "claim", 26, 40, 41)
def goals_that_waited_are_forgotten(real: Any) -> Any:
    """Take over only goals that were running."""

    def claim(self: AnyRecovery, stored: StoredGoal) -> None:
        if stored.is_running or stored.status.is_terminal:
            real(self, stored)

    return claim


@mistake(Recovery, "claim", 25, 68)
def outcomes_are_forgotten(real: Any) -> Any:
    """Take over only goals that are active."""

    def claim(self: AnyRecovery, stored: StoredGoal) -> None:
        if stored.status.is_active:
            real(self, stored)

    return claim


# Recovered wrongly


@mistake(Recovery, "claim", 67, 41)
def a_cancel_is_forgotten_at_a_restart(real: Any) -> Any:
    """Run goals again whose cancel was accepted."""

    def claim(self: AnyRecovery, stored: StoredGoal) -> None:
        if stored.status is GoalStatus.CANCELING:
            stored.status = GoalStatus.EXECUTING
        real(self, stored)

    return claim


@mistake(Checkpoints, "restored", 47, 52, 54)
def no_checkpoint_is_restored(_real: Any) -> Any:
    """Begin each attempt from nothing."""

    def restored(self: Checkpoints, stored: StoredGoal) -> None:
        return None

    return restored


@mistake(GoalKeeper, "checkpoint", 26, 33, 25)
def only_the_first_checkpoint_is_kept(real: Any) -> Any:
    """Write the first checkpoint of a goal again instead of a later one."""

    def checkpoint(self: GoalKeeper, goal: GoalRecord, state: bytes) -> int:
        assert goal.stored is not None
        write: int = real(self, goal, goal.stored.checkpoint or state)
        return write

    return checkpoint


@mistake(LostAttempts, "reason_to_end", 20, 33, 54)
def a_goal_is_never_given_up(real: Any) -> Any:
    """Run a goal again however often its process has died."""

    def reason_to_end(self: AnyLostAttempts, stored: StoredGoal) -> Any:
        self._max_attempts = 10**9
        return real(self, stored)

    return reason_to_end


@mistake(LostAttempts, "reason_to_end", 1, 20, 25)
def a_goal_runs_again_whatever_the_recovery_says(_real: Any) -> Any:
    """Do not ask what is to become of a goal that was running."""

    def reason_to_end(self: AnyLostAttempts, stored: StoredGoal) -> str:
        return ""

    return reason_to_end


@mistake(Recovery, "claim", 67)
def a_goal_that_waited_counts_as_lost(real: Any) -> Any:
    """Treat goals that had not begun as if their attempt was lost."""

    def claim(self: AnyRecovery, stored: StoredGoal) -> None:
        stored.is_running = stored.status.is_active
        real(self, stored)

    return claim


@mistake(Runs, "begin", 28, 40, 41)
def an_attempt_has_the_number_of_the_one_before(real: Any) -> Any:
    """Do not count attempts."""

    def begin(self: AnyRuns, goal_id: GoalID) -> None:
        if (run := self._runs.get(goal_id)) is not None:
            run.goal.attempt = 1
        real(self, goal_id)

    return begin


@mistake(GoalRegistry, "restore", 18, 1, 20)
def a_restored_goal_has_another_stamp(real: Any) -> Any:
    """Give goals a new stamp at each restart, so that they look like others to their clients."""

    def restore(self: GoalRegistry, stored: StoredGoal, **keywords: Any) -> GoalRecord:
        stored.stamp += 1
        goal: GoalRecord = real(self, stored, **keywords)
        return goal

    return restore


@mistake(GoalRegistry, "restore", 20, 25, 33)
def the_outcome_of_a_restored_goal_expires_at_once(real: Any) -> Any:
    """Count the result timeout from an end at the restart on, though the client is away."""

    def restore(
        self: GoalRegistry, stored: StoredGoal, *, until: float = 0.0, **keywords: Any
    ) -> GoalRecord:
        goal: GoalRecord = real(self, stored, until=-math.inf, **keywords)
        return goal

    return restore


# At a stop


@mistake(runs, "is_kept", 192, 52)
def a_goal_that_is_kept_is_told_as_aborted(_real: Any) -> Any:
    """End goals at a planned restart that are to be kept."""

    def is_kept(*_: Any, **_keywords: Any) -> bool:
        return False

    return is_kept


@mistake(GoalKeeper, "_write_release", 192, 52)
def a_goal_that_is_kept_is_not_released(_real: Any) -> Any:
    """Leave goals that are kept at a planned restart as running."""

    def _write_release(self: GoalKeeper, run: AnyRun) -> None:
        pass

    return _write_release

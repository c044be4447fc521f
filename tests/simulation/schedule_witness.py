"""The source of a record's facts about schedules: what servers give, take and interrupt."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from fibaction import GoalID
from fibaction.server.execution.executor import Execution, Run
from fibaction.server.execution.runs import Runs
from fibaction.server.registry.goal_record import Ending
from fibaction.server.scheduling.goal_dispatcher import GoalDispatcher
from fibaction.server.scheduling.scheduled_goals import Busy
from fibaction.words.goals import Sender
from tests.simulation.facts import Life, Truth
from tests.simulation.invariants import Record
from tests.simulation.scenario import Work

AnyRuns = Runs[Any, Any, Any]


def schedule_wrappers(record: Record) -> Iterator[tuple[type, str, Callable[[Any], Any]]]:
    """Yield methods of the product to be wrapped, each with the function that makes the wrapper."""
    yield GoalDispatcher, "offer", lambda real: _offering(real, record)
    yield Runs, "_call", lambda real: _beginning(real, record)
    yield Runs, "interrupt", lambda real: _interrupting(real, record)
    yield Runs, "kill", lambda real: _killing(real, record)
    yield Runs, "take_over", lambda real: _taking_over(real, record)
    yield Runs, "_end", lambda real: _ending(real, record)


def _truth_of(record: Record, runs: AnyRuns, goal_id: GoalID) -> Truth | None:
    run = runs._runs.get(goal_id)
    return None if run is None else record.truth(goal_id, run.goal.stamp)


def _offering(real: Any, record: Record) -> Any:
    def offer(
        self: GoalDispatcher[Any], goal_id: GoalID, work: Work, sender: Sender, deadline: float
    ) -> Any:
        life: Life = record.life_of(self)
        record.places.offered(life, goal_id, work)
        try:
            return real(self, goal_id, work, sender, deadline)
        except Busy as busy:
            record.places.rejected(life, goal_id, str(busy))
            raise

    return offer


def _beginning(real: Any, record: Record) -> Any:
    def _begin(self: AnyRuns, run: Run[Any, Any, Any]) -> None:
        truth = record.truth(run.goal.goal_id, run.goal.stamp)
        if truth is not None:
            record.places.begun(truth)
        real(self, run)

    return _begin


def _interrupting(real: Any, record: Record) -> Any:
    def interrupt(self: AnyRuns, goal_id: GoalID, reason: str) -> None:
        truth = _truth_of(record, self, goal_id)
        if truth is not None:
            record.places.interrupted(truth, reason)
        real(self, goal_id, reason)

    return interrupt


def _killing(real: Any, record: Record) -> Any:
    def kill(self: AnyRuns, goal_id: GoalID, reason: str = "", *, for_good: bool) -> None:
        truth = _truth_of(record, self, goal_id)
        if truth is not None and not for_good:
            record.places.killed(truth)
        real(self, goal_id, reason, for_good=for_good)

    return kill


def _taking_over(real: Any, record: Record) -> Any:
    def take_over(self: AnyRuns, goal_id: GoalID, successor: GoalID) -> None:
        old, new = _truth_of(record, self, goal_id), _truth_of(record, self, successor)
        assert old is not None
        assert new is not None
        if old.result is None:  # else it fails
            record.places.taken_over(old, new)
        real(self, goal_id, successor)
        if old.outcome is None and record.scenario.server.store is None:
            record.fail("turn", f"goal {goal_id} goes on beside the one that it has taken over")

    return take_over


def _ending(real: Any, record: Record) -> Any:
    def _end(self: AnyRuns, execution: Execution[Any, Any, Any], ending: Ending) -> None:
        truth = record.truth(execution.handle.goal_id, execution.handle.stamp)
        if truth is not None and not truth.starts:
            record.places.left(truth)
        real(self, execution, ending)

    return _end

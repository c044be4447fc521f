"""`Run`: an active goal of a server, and `GoalNews`: what its followers are told."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Generic, TypeAlias

from fibaction.server.durability.keeper import Acts
from fibaction.server.goal_logs import GoalLogs
from fibaction.server.life import Effect
from fibaction.server.registry.registry import GoalRegistry
from fibaction.types.action import FeedbackT, GoalT, ResultT
from fibaction.words.errors import GoalKept
from fibaction.words.goals import GoalID
from fibaction.words.statuses import GoalStatus

if TYPE_CHECKING:
    from fibaction.feeds.feedback_log import FeedbackLog
    from fibaction.server.execution.executor import Execution
    from fibaction.server.registry.goal_record import GoalRecord
    from fibaction.words.errors import ConnectionLost
    from fibaction.words.goals import Outcome


class Run(Generic[GoalT, FeedbackT, ResultT]):
    """An active goal: its record, its log with the followers, and its executor."""

    __slots__ = ("error", "execution", "goal", "log", "outcome")

    def __init__(
        self,
        goal: GoalRecord,
        log: FeedbackLog[GoalRecord],
        execution: Execution[GoalT, FeedbackT, ResultT],
    ) -> None:
        self.goal = goal
        self.log = log
        self.execution = execution
        self.error: ConnectionLost | None = None
        """The error for the followers of a goal that leaves without an end."""
        self.outcome: Outcome[bytes] | None = None
        """The outcome once it is fixed; the goal's record has it once it is told."""


AnyRun: TypeAlias = Run[Any, Any, Any]


class GoalNews:
    """The effects of goals' lives that tell followers something, and end records."""

    def __init__(self, runs: dict[GoalID, AnyRun], registry: GoalRegistry, logs: GoalLogs) -> None:
        """Remove goals that leave from `runs`."""
        self._runs = runs
        self._registry = registry
        self._logs = logs

    def acts(self) -> Acts[AnyRun]:
        """Return the functions that carry out the effects which tell."""
        return {
            Effect.RUN_AHEAD: self._run_ahead,
            Effect.TELL_EXECUTING: self._tell_executing,
            Effect.TELL_TAKE_OVER: self._tell_take_over,
            Effect.TELL_CANCELING: lambda run: self._tell(run, run.goal.status),
            Effect.TELL_END: self._tell_end,
            Effect.TELL_GONE: self._tell_gone,
        }

    def _tell_executing(self, run: AnyRun) -> None:
        if run.goal.status is GoalStatus.ACCEPTED:  # else an earlier attempt has begun
            self._registry.execute(run.goal)
            run.goal.began_at = time.time_ns()
            run.goal.told_status = run.goal.status
            self._logs.tell_status(run.log)

    def _run_ahead(self, run: AnyRun) -> None:
        # The executor runs already. Nothing of this attempt may be told before it is kept: the next
        # attempt would have the same number.
        self._registry.execute(run.goal)
        run.goal.began_at = time.time_ns()
        run.log.is_hidden = True

    def _tell_take_over(self, run: AnyRun) -> None:
        self._tell(run, GoalStatus.EXECUTING)  # a cancel of it may not be kept yet
        run.log.reveal()

    def _tell(self, run: AnyRun, status: GoalStatus) -> None:
        """Tell a status that is kept by now."""
        run.goal.told_status = status
        self._logs.tell_status(run.log)

    def _tell_end(self, run: AnyRun) -> None:
        """Make the outcome the goal's, for as long as results are kept, and tell it."""
        goal = run.goal
        assert run.outcome is not None
        if goal.told_status is not goal.status:
            self._tell(run, goal.status)
        now = self._logs.now()
        self._registry.finish(goal, run.outcome, now=now, stamp=time.time_ns())
        del self._runs[goal.goal_id]
        self._logs.end(run.log, now)

    def _tell_gone(self, run: AnyRun) -> None:
        """End the streams of a goal that does not end here, and forget it."""
        error = run.error
        assert error is not None
        del self._runs[run.goal.goal_id]
        self._registry.release(run.goal)
        if isinstance(error, GoalKept):
            self._logs.keep(run.log, error)
        else:
            self._logs.lose(run.log, error)

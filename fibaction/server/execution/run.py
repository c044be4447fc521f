"""`Run`: an active goal of a server, as `Runs` has it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Generic

from fibaction.types.action import FeedbackT, GoalT, ResultT

if TYPE_CHECKING:
    from fibaction.feeds.feedback_log import FeedbackLog
    from fibaction.server.execution.executor import Execution
    from fibaction.server.registry.goal_record import GoalRecord
    from fibaction.words.goals import Outcome


class Run(Generic[GoalT, FeedbackT, ResultT]):
    """An active goal: its record, its log with the followers, and its executor."""

    __slots__ = ("execution", "goal", "has_begun", "is_waiting", "log", "outcome")

    def __init__(
        self,
        goal: GoalRecord,
        log: FeedbackLog[GoalRecord],
        execution: Execution[GoalT, FeedbackT, ResultT],
    ) -> None:
        self.goal = goal
        self.log = log
        self.execution = execution
        self.is_waiting = True
        """True until the executor is to begin."""
        self.has_begun = False
        """True when the executor begins: with a store, when its begin is kept."""
        self.outcome: Outcome[bytes] | None = None
        """The outcome once it is fixed; the goal's record has it once it is told."""

"""`Run`: an active goal of a server, as `Runs` has it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Generic

from fibaction.types.action import FeedbackT, GoalT, ResultT

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

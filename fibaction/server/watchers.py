"""`Watchers`: what a server tells its watchers; this one is for a server without any.

`WatcherGroup` calls those that there are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fibaction.feeds.feedback_log import FeedbackLog

if TYPE_CHECKING:
    from contextvars import Context

    from fibaction.border.byte_budgets import ByteBudget
    from fibaction.border.watchers import Watcher
    from fibaction.server.registry.goal_record import GoalRecord
    from fibaction.types.action import ActionInfo
    from fibaction.words.goals import CancelAnswer, GoalID, Sender
    from fibaction.words.meta import Meta


class Watchers:
    """The watchers of one server, as one: it has none."""

    members: tuple[Watcher, ...] = ()
    """The watchers."""

    def opened(self, info: ActionInfo) -> None:
        """Tell that the server starts."""

    def offered(self, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta) -> Context | None:
        """Tell that a goal was offered, and return the context for its executor; None for that of
        the call that accepts it.
        """
        return None

    def taken_over(
        self, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta
    ) -> Context | None:
        """Tell that a goal comes from the store, and return the context, as `offered` does."""
        return None

    def rejected(self, goal_id: GoalID, reason: str) -> None:
        """Tell that a goal was rejected."""

    def accepted(
        self, goal: GoalRecord, window: int, latest: bool, budget: ByteBudget, payload: bytes
    ) -> FeedbackLog[GoalRecord]:
        """Tell that a goal was accepted, and return its log, which tells what follows."""
        return FeedbackLog(goal, window, latest, budget, payload)

    def canceled(self, goal_id: GoalID | None, answer: CancelAnswer) -> None:
        """Tell the answer to a cancel."""

    def left(self, goal: GoalRecord, reason: str) -> None:
        """Tell that a goal is the server's no longer."""

    def closed(self, info: ActionInfo) -> None:
        """Tell that the server has stopped."""

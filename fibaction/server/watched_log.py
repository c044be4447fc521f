"""`WatchedLog`: a feedback log that tells each message to the watchers of its server."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fibaction._runtime.budget import ByteBudget
from fibaction.border.abc import FeedbackItem
from fibaction.feeds.feedback_log import FeedbackLog
from fibaction.server.registry.goal_record import GoalRecord

if TYPE_CHECKING:
    from fibaction.server.watcher_group import WatcherGroup


class WatchedLog(FeedbackLog[GoalRecord]):
    """The log of a goal of a server with watchers. Logs of other servers do not pay for them."""

    __slots__ = ("_watchers",)

    def __init__(
        self,
        watchers: WatcherGroup,
        goal: GoalRecord,
        window: int,
        latest: bool,
        budget: ByteBudget,
        payload: bytes,
    ) -> None:
        super().__init__(goal, window, latest, budget, payload)
        self._watchers = watchers

    def append(self, payload: bytes) -> None:
        super().append(payload)
        goal = self.goal
        item = FeedbackItem(goal.feedback_count, payload, goal.attempt)
        self._watchers.feedback(goal.goal_id, item)

    def note_dropped(self, count: int) -> None:
        self._watchers.missed(self.goal.goal_id, count)

"""`Watchers`: what a server tells its watchers, whether it has any or not.

`WatcherGroup` calls them. A server without watchers has `NoWatchers`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

from fibaction.feeds.feedback_log import FeedbackLog

if TYPE_CHECKING:
    from contextvars import Context

    from fibaction._runtime.budget import ByteBudget
    from fibaction.border.watchers import Watcher
    from fibaction.server.registry.goal_record import GoalRecord
    from fibaction.types.action import ActionInfo
    from fibaction.words.goals import CancelAnswer, GoalID, Sender
    from fibaction.words.meta import Meta


class Watchers(ABC):
    """The watchers of one server, as one."""

    members: tuple[Watcher, ...]
    """The watchers."""

    @abstractmethod
    def opened(self, info: ActionInfo) -> None:
        """Tell that the server starts."""

    @abstractmethod
    def offered(self, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta) -> Context | None:
        """Tell that a goal was offered, and return the context for its executor; None for that of
        the call that accepts it.
        """

    @abstractmethod
    def taken_over(
        self, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta
    ) -> Context | None:
        """Tell that a goal comes from the store, and return the context, as `offered` does."""

    @abstractmethod
    def rejected(self, goal_id: GoalID, reason: str) -> None:
        """Tell that a goal was rejected."""

    @abstractmethod
    def accepted(
        self, goal: GoalRecord, window: int, latest: bool, budget: ByteBudget, payload: bytes
    ) -> FeedbackLog[GoalRecord]:
        """Tell that a goal was accepted, and return its log, which tells what follows."""

    @abstractmethod
    def canceled(self, goal_id: GoalID | None, answer: CancelAnswer) -> None:
        """Tell the answer to a cancel."""

    @abstractmethod
    def left(self, goal: GoalRecord, reason: str) -> None:
        """Tell that a goal is the server's no longer."""

    @abstractmethod
    def closed(self, info: ActionInfo) -> None:
        """Tell that the server has stopped."""


class NoWatchers(Watchers):
    """The watchers of a server that has none."""

    members = ()

    def opened(self, info: ActionInfo) -> None:
        """Do nothing, as below."""

    def offered(self, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta) -> None:
        return None

    def taken_over(self, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta) -> None:
        return None

    def rejected(self, goal_id: GoalID, reason: str) -> None:
        """Do nothing."""

    def accepted(
        self, goal: GoalRecord, window: int, latest: bool, budget: ByteBudget, payload: bytes
    ) -> FeedbackLog[GoalRecord]:
        return FeedbackLog(goal, window, latest, budget, payload)

    def canceled(self, goal_id: GoalID | None, answer: CancelAnswer) -> None:
        """Do nothing."""

    def left(self, goal: GoalRecord, reason: str) -> None:
        """Do nothing."""

    def closed(self, info: ActionInfo) -> None:
        """Do nothing."""

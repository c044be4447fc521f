"""The goal that an executor works for, as a context variable."""

from __future__ import annotations

from contextvars import ContextVar
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fibaction.words.goals import GoalID


class CurrentGoal:
    """The action and the ID of a goal; the ID changes if the executor takes its successor over."""

    __slots__ = ("action", "goal_id")

    def __init__(self, action: str, goal_id: GoalID) -> None:
        self.action = action
        self.goal_id = goal_id


current_goal: ContextVar[CurrentGoal | None] = ContextVar("current_goal", default=None)
"""The goal of the executor that this code is called by; None outside executors."""

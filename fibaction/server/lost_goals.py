"""`Losses`: goals that belong to another server by now, wherever this server has them."""

from __future__ import annotations

from typing import Any

from fibaction.server.admission.admission import Admission
from fibaction.server.durability.recovery import Recovery
from fibaction.server.execution.runs import Runs
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.words.goals import GoalID


class Losses:
    """The losses of one server, as its store tells them."""

    def __init__(
        self,
        admission: Admission[Any, Any, Any],
        runs: Runs[Any, Any, Any],
        recovery: Recovery[Any, Any, Any],
    ) -> None:
        self._admission = admission
        self._runs = runs
        self._recovery = recovery

    def lose(self, goal_id: GoalID) -> None:
        """Let go of a goal that another server has taken over; of an unknown one, nothing."""
        self._recovery.forget(goal_id)
        goal = self._admission.writing(goal_id) or self._runs.record_of(goal_id)
        if goal is not None:
            self.lose_record(goal)

    def lose_record(self, goal: GoalRecord) -> None:
        """Let go of a goal of which a write was refused, because another server has it."""
        if not self._admission.lose(goal):
            self._runs.lose(goal)

"""`GoalHandle`: one goal, as its executor and the callbacks of the server see it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Generic

from fibaction.action import GoalT
from fibaction.states import GoalStatus

if TYPE_CHECKING:
    from fibaction.goals import GoalID
    from fibaction.server.goal_record import GoalRecord


class GoalHandle(Generic[GoalT]):
    """One goal, as its executor sees it."""

    __slots__ = ("_goal", "request")

    def __init__(self, goal: GoalRecord, request: GoalT) -> None:
        self.request = request
        """The goal that the client sent."""
        self._goal = goal

    @property
    def goal_id(self) -> GoalID:
        """The goal's ID, made by the client."""
        return self._goal.goal_id

    @property
    def stamp(self) -> int:
        """Time of the acceptance: nanoseconds since 1970."""
        return self._goal.stamp

    @property
    def deadline(self) -> float:
        """Time at which the client gives the goal up, by the clock of `anyio.current_time()`;
        `math.inf` if it does not. The server does not enforce it.
        """
        return self._goal.deadline

    @property
    def status(self) -> GoalStatus:
        """The goal's status now."""
        return self._goal.status

    @property
    def cancel_requested(self) -> bool:
        """True if the goal is to stop: its cancel was accepted, or the server ends it."""
        return self._goal.status is GoalStatus.CANCELING or bool(self._goal.stop_reason)

    def __repr__(self) -> str:
        return f"<GoalHandle {self.goal_id} {self.status.name}>"

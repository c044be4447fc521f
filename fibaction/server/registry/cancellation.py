"""The answer to a cancel: the rules of `action_msgs/srv/CancelGoal`.

`GoalRegistry.cancel` chooses the goals. Sans-I/O: this calls no callbacks and interrupts no
executors.
"""

from __future__ import annotations

from operator import attrgetter

from fibaction._runtime.text import REASON, shortened
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.words.goals import CancelAnswer, CancelCode, GoalID, GoalInfo
from fibaction.words.statuses import GoalEvent, GoalStatus, transition


class Cancellation:
    """One request to cancel, with a snapshot of the goals it means.

    The caller calls `accept` or `reject` for each of `candidates`, in any order and at any time;
    then `answer()` returns the answer for the client.
    """

    def __init__(self, candidates: tuple[GoalRecord, ...], otherwise: CancelCode) -> None:
        self.candidates = candidates
        """The goals that were active when the cancel arrived, CANCELING ones included."""
        self._otherwise = otherwise
        self._canceling: dict[GoalID, GoalInfo] = {}
        self._reasons: dict[str, None] = {}
        self._length = 0

    def accept(self, goal: GoalRecord) -> bool:
        """Move the goal to CANCELING, and return True; return False if its end is fixed by now."""
        if not (goal.phase.is_open and goal.status.is_active):
            return False
        if goal.status is not GoalStatus.CANCELING:
            goal.status = transition(goal.status, GoalEvent.CANCEL_GOAL)
        self._canceling[goal.goal_id] = goal.info_as(goal.status)
        return True

    def leave_out(self, goal: GoalRecord) -> None:
        """Leave a goal out that belongs to another server by now."""
        self._canceling.pop(goal.goal_id, None)
        if self._otherwise is CancelCode.GOAL_TERMINATED:  # it is the only one that was meant
            self._otherwise = CancelCode.UNKNOWN_GOAL_ID

    def reject(self, reason: str) -> None:
        """Note the reason for which a goal is not canceled."""
        if reason not in self._reasons and self._length < REASON:
            self._reasons[reason] = None
            self._length += len(reason)

    def answer(self) -> CancelAnswer:
        """Return the answer: NONE if any goal is canceling, REJECTED if all were rejected."""
        # In the order of acceptance. They are nearly in order already, so sorting is fast.
        canceling = tuple(sorted(self._canceling.values(), key=attrgetter("stamp")))
        if canceling:
            code = CancelCode.NONE
        elif self._reasons:
            code = CancelCode.REJECTED
        else:
            code = self._otherwise
        return CancelAnswer(code, canceling, shortened("; ".join(self._reasons)))

"""`ReadableCheck`: which stored goals this version can read, and the refusal to start without.

For example, a new version has a required field that the goals in the store do not have. If they
were ended, going back to the old version would not bring them back. So the check comes before
anything is written or run. Where several servers share a store, it comes before this server takes
a goal, and another one can have it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Generic

from fibaction._runtime.slices import Slices
from fibaction._runtime.text import excerpt
from fibaction.border.goal_store import StoredGoal
from fibaction.server.durability.checkpoints import Checkpoints
from fibaction.server.durability.lost_attempts import LostAttempts
from fibaction.server.scheduling.dispatcher import Dispatcher
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.words.errors import ProtocolError, StoreError
from fibaction.words.goals import GoalID
from fibaction.words.statuses import GoalStatus

NAMED = 3
"""The goals whose IDs are in the error."""


class ReadableCheck(Generic[GoalT, FeedbackT, ResultT]):
    """The check of the goals of one action, before its server starts."""

    def __init__(
        self,
        action: Action[GoalT, FeedbackT, ResultT],
        checkpoints: Checkpoints,
        dispatcher: Dispatcher[GoalT],
        lost_attempts: LostAttempts[GoalT, FeedbackT, ResultT],
        *,
        refuses: bool,
    ) -> None:
        self._action = action
        self._checkpoints = checkpoints
        self._dispatcher = dispatcher
        self._lost_attempts = lost_attempts
        self._refuses = refuses

    async def check(self, goals: Iterable[StoredGoal]) -> None:
        """Check that all goals that are to run can be read.

        Raises:
            StoreError: Some cannot be read, and the server is to refuse them.
        """
        if not self._refuses:
            return
        slices = Slices()
        failures: dict[GoalID, str] = {}
        for stored in goals:
            if self._is_to_run(stored) and (reason := self._failure_of(stored)):
                failures[GoalID(stored.goal_id)] = reason
            await slices.pause()
        if failures:
            raise self._error(failures)

    def obstacle(self, stored: StoredGoal) -> str:
        """Return why this server cannot run a goal; empty if it can.

        A goal whose cancel was accepted is not run again, so any server can end it.
        """
        return "" if stored.status is GoalStatus.CANCELING else self._failure_of(stored)

    def _is_to_run(self, stored: StoredGoal) -> bool:
        """Return False for a goal that has ended, or that ends in any case."""
        if stored.status.is_terminal or stored.status is GoalStatus.CANCELING:
            return False
        return not (stored.is_running and self._lost_attempts.reason_to_end(stored))

    def _failure_of(self, stored: StoredGoal) -> str:
        """Return why a goal cannot run; empty if it can."""
        try:
            request = self._action.goal.decode(stored.goal)
            self._checkpoints.restored(stored)
        except ProtocolError as exc:
            return str(exc)
        return self._dispatcher.failure_of(request, stored.sender)

    def _error(self, failures: dict[GoalID, str]) -> StoreError:
        named = ", ".join(map(str, list(failures)[:NAMED]))
        goals = "1 goal" if len(failures) == 1 else f"{len(failures):,} goals"
        more = ", and others" if len(failures) > NAMED else ""
        reason = excerpt(next(iter(failures.values())), 400)
        return StoreError(
            f"the store has {goals} that this version of action {self._action.name!r} cannot read"
            f" ({named}{more}): {reason}; nothing was changed: start the version that accepted"
            f" them, or end them as ABORTED with unreadable='abort'"
        )

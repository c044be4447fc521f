"""`StoredEnds`: what a store keeps of goals that have ended, and for how long.

Of most goals it keeps the outcome. A goal that was given up is kept whole, with its last
checkpoint, so that a person can look at it and run it again.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from fibaction.words.statuses import GoalStatus

if TYPE_CHECKING:
    from fibaction.border.goal_store import StoredGoal
    from fibaction.server.registry.goal_record import GoalRecord
    from fibaction.words.goals import Outcome

OUTCOME_GRACE = 60.0
"""Seconds for which a store keeps an outcome beyond the result timeout: the client may have waited
for it while the server was away."""
SECOND = 1_000_000_000
LONGEST = 1e9
"""Seconds above which a time is kept as unlimited: about 30 years."""


class StoredEnds:
    """The rule for the ends of one server."""

    def __init__(self, keep_for: float, given_up_for: float) -> None:
        """Keep outcomes for so many seconds, and goals that were given up for as many others."""
        self._keep_for = keep_for + OUTCOME_GRACE
        self._given_up_for = given_up_for

    def write(self, stored: StoredGoal, goal: GoalRecord, outcome: Outcome[bytes]) -> None:
        """Bring a stored goal up to date with its end."""
        stored.status, stored.result = outcome.status, outcome.result
        stored.reason = outcome.reason
        stored.is_running = False
        stored.feedback_count, stored.ended_at = goal.feedback_count, time.time_ns()
        seconds = self._keep_for
        if goal.is_given_up and outcome.status is GoalStatus.ABORTED and self._given_up_for:
            seconds = max(seconds, self._given_up_for)
        else:
            stored.drop_request()
        if seconds < LONGEST:
            stored.keep_until = stored.ended_at + int(seconds * SECOND)

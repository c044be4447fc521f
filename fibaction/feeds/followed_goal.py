"""A goal as its followers see it: `FollowedGoal`, and `GoalFacts` for goals of another system."""

from __future__ import annotations

from time import monotonic_ns, time_ns
from typing import Protocol

from fibaction.words.goals import GoalID, GoalInfo, Outcome
from fibaction.words.statuses import GoalStatus


class Held(Protocol):
    """Bytes that count in a budget for as long as this object is referenced."""

    size: int
    """The bytes that are counted."""

    def resize(self, size: int) -> None:
        """Count so many bytes in place of those until now."""


class FollowedGoal(Protocol):
    """A goal that is followed; the record of a server is one."""

    goal_id: GoalID
    stamp: int
    """Time of the acceptance: nanoseconds since 1970."""
    clock: int
    """The nanoseconds from the monotonic clock to the times that are told of the goal."""
    attempt: int
    """Number of the attempt that runs, from 1."""
    feedback_count: int
    """Number of the last feedback message of this attempt. A `FeedbackLog` counts here."""
    outcome: Outcome[bytes] | None
    """The outcome; None until the goal ends."""

    @property
    def info(self) -> GoalInfo:
        """The goal as an entry of a list, as far as it is known here."""
        ...

    @property
    def held(self) -> Held | None:
        """The bytes that are held of the goal; None if they are not counted."""
        ...

    @property
    def told_status(self) -> GoalStatus:
        """The status that followers may know."""
        ...


class GoalFacts:
    """A goal that runs in another system, as far as it is known here."""

    __slots__ = (
        "attempt",
        "clock",
        "feedback_count",
        "goal_id",
        "held",
        "outcome",
        "stamp",
        "told_info",
        "told_status",
    )

    def __init__(self, goal_id: GoalID, stamp: int) -> None:
        self.goal_id = goal_id
        self.stamp = stamp
        self.clock = time_ns() - monotonic_ns()
        self.attempt = 1
        self.feedback_count = 0
        self.outcome: Outcome[bytes] | None = None
        self.held: Held | None = None
        self.told_status = GoalStatus.ACCEPTED
        self.told_info: GoalInfo | None = None
        """The goal as an entry of a list, if the other system has told all of it at once."""

    @property
    def info(self) -> GoalInfo:
        """See `FollowedGoal.info`."""
        if self.told_info is not None:
            return self.told_info
        status, count = self.told_status, self.feedback_count
        return GoalInfo(self.goal_id, self.stamp, status, count, attempt=self.attempt)

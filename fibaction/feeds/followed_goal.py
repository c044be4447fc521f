"""A goal as its followers see it: `FollowedGoal`, and `GoalFacts` for goals of another system."""

from __future__ import annotations

from typing import Protocol

from fibaction.words.goals import GoalID, Outcome, Parent
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
    attempt: int
    """Number of the attempt that runs, from 1."""
    feedback_count: int
    """Number of the last feedback message of this attempt. A `FeedbackLog` counts here."""
    outcome: Outcome[bytes] | None
    """The outcome; None until the goal ends."""

    @property
    def parent(self) -> Parent | None:
        """The goal whose executor has sent this one; None if there is none or it is not known."""
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
        "feedback_count",
        "goal_id",
        "held",
        "outcome",
        "parent",
        "stamp",
        "told_status",
    )

    def __init__(self, goal_id: GoalID, stamp: int) -> None:
        self.goal_id = goal_id
        self.stamp = stamp
        self.parent: Parent | None = None
        self.attempt = 1
        self.feedback_count = 0
        self.outcome: Outcome[bytes] | None = None
        self.held: Held | None = None
        self.told_status = GoalStatus.ACCEPTED

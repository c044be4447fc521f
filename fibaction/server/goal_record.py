"""An accepted goal as the server keeps it, and how its executor left off. Plain values."""

from __future__ import annotations

from enum import Enum
from hashlib import blake2b

import msgspec

from fibaction.goals import GoalID, GoalInfo, Outcome, Sender
from fibaction.states import INITIAL, GoalStatus

DIGEST_SIZE = 16
"""Bytes of a digest: enough that two goals of one ID never share one by chance."""


def digest_of(payload: bytes) -> bytes:
    """Return what tells a goal that is sent again from another goal of the same ID.

    It is the same in every process, so it can be written down, and it keeps no payload alive.
    """
    return blake2b(payload, digest_size=DIGEST_SIZE).digest()


class GoalRecord:
    """The record of one accepted goal."""

    __slots__ = (
        "digest",
        "ended_at",
        "feedback_count",
        "goal_id",
        "outcome",
        "sender",
        "stamp",
        "status",
    )

    def __init__(self, goal_id: GoalID, digest: bytes, stamp: int, sender: Sender) -> None:
        self.goal_id = goal_id
        self.digest = digest
        self.stamp = stamp
        """Time of the acceptance: nanoseconds since 1970, different for each goal."""
        self.sender = sender
        """The client that sent it, which owns it."""
        self.status: GoalStatus = INITIAL
        self.outcome: Outcome[bytes] | None = None
        self.ended_at = 0
        """Time of the end: nanoseconds since 1970; 0 while the goal is active."""
        self.feedback_count = 0

    @property
    def info(self) -> GoalInfo:
        """The goal as a line of the status list."""
        return GoalInfo(
            self.goal_id, self.stamp, self.status, self.feedback_count, self.sender.name
        )


class EndKind(Enum):
    """The way in which an executor left off."""

    RESULT = "result"
    CANCELED = "canceled"
    FAILED = "failed"


class Ending(msgspec.Struct, frozen=True):
    """All that an executor leaves behind. The status before decides which outcome that is."""

    kind: EndKind
    result: bytes | None = None
    reason: str = ""

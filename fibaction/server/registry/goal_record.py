"""A goal that is offered, the record of an accepted one, and the ending of its executor."""

from __future__ import annotations

import math
from enum import Enum
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, cast

import msgspec

from fibaction._runtime.text import LENGTH, shortened
from fibaction.server.life import Phase
from fibaction.types.action import GoalT
from fibaction.words.errors import GoalRejected, RejectionCode
from fibaction.words.goals import GoalID, GoalInfo, Outcome, Sender
from fibaction.words.meta import UNKNOWN_ORIGIN, Meta, origin_in
from fibaction.words.statuses import INITIAL, GoalStatus

if TYPE_CHECKING:
    from contextvars import Context

    from fibaction.border.abc import GoalRequest
    from fibaction.border.goal_store import RecordTooLarge, StoredGoal
    from fibaction.feeds.feedback_log import FeedbackCursor, FeedbackLog
    from fibaction.server.registry.kept_results import HeldBytes

NO_PLACE = (0, 0)
"""The place of a goal that does not wait."""

LEAST_TIME = 30.0
"""Seconds for which an outcome is remembered at least, if the client of the goal may not have been
told the acceptance, or was away with the server: it comes back within that time."""

# Looked up for each goal: a name of this module is found faster than a member of an enum.
DECIDING = Phase.DECIDING


class GoalRecord:
    """The record of one accepted goal."""

    __slots__ = (
        "attempt",
        "began_at",
        "changed",
        "clock",
        "deadline",
        "digest",
        "ended_at",
        "feedback_count",
        "goal_id",
        "goes_on",
        "held",
        "is_given_up",
        "log",
        "origin",
        "outcome",
        "phase",
        "place",
        "remember_until",
        "sender",
        "stamp",
        "status",
        "stop_reason",
        "stored",
        "suspicion",
        "told_status",
    )

    def __init__(
        self,
        goal_id: GoalID,
        digest: bytes,
        stamp: int,
        sender: Sender,
        held: HeldBytes | None = None,
        deadline: float = math.inf,
    ) -> None:
        self.goal_id = goal_id
        self.digest = digest
        self.stamp = stamp
        """Time of the acceptance: nanoseconds since 1970, different for each goal."""
        self.clock = 0
        """The nanoseconds from the monotonic clock to the times that are told of the goal: so a
        step of the wall clock does not change how long it has waited and ran."""
        self.sender = sender
        """The client that sent the goal, and owns it."""
        self.origin = UNKNOWN_ORIGIN
        """The parent and the labels of the goal."""
        self.deadline = deadline
        """Time at which the client gives up the goal, by the event loop's clock."""
        self.attempt = 1
        """Number of the attempt that runs, or that comes next. A server without a store makes one.
        """
        self.phase = DECIDING
        """The phase of the goal's life at the server: see `life`."""
        self.status: GoalStatus = INITIAL
        self.told_status: GoalStatus = INITIAL
        """The status that followers may know: the last one that the store has acknowledged."""
        self.outcome: Outcome[bytes] | None = None
        """The outcome; None while the goal is active, and again after the server has forgotten it.
        The log of the goal has its own reference, for those that still follow it."""
        self.stored: StoredGoal | None = None
        """The goal in the store; None without a store, and after the end."""
        self.held = held
        """The bytes that are held of the goal: its payload, then its result; None after the server
        has forgotten it."""
        self.log: FeedbackLog[GoalRecord] | None = None
        """The log that it is followed from; None after the end: see `GoalLogs`."""
        self.began_at: int | None = None
        """Time at which the first attempt began: nanoseconds since 1970; None if none has."""
        self.ended_at = 0
        """Time of the end: nanoseconds since 1970; 0 while the goal is active."""
        self.remember_until = 0.0
        """Time until which the outcome is remembered at least, by the event loop's clock."""
        self.feedback_count = 0
        self.changed = 0
        """Number of the last published change of its status; 0 if no one follows the statuses."""
        self.place: tuple[int, int] = NO_PLACE
        """Place among the goals that wait, from 1, and their number. It counts while the goal is
        ACCEPTED, and is brought up to date before a list of goals is made."""
        self.stop_reason = ""
        """The reason for which the server ends the goal by itself; empty if it does not."""
        self.goes_on = False
        """True if the server interrupts this attempt, and the goal continues in another one."""
        self.suspicion = ""
        """The reason for which the goal is to run alone; empty if it need not: see `suspects`."""
        self.is_given_up = False
        """True if the server ends the goal instead of running it again, or has ended it so."""

    @classmethod
    def of_stored(cls, stored: StoredGoal, held: HeldBytes, deadline: float) -> GoalRecord:
        """Make the record of a goal that was accepted by an earlier process."""
        goal_id = GoalID(stored.goal_id)
        goal = cls(goal_id, stored.digest, stored.stamp, stored.sender, held, deadline)
        goal.phase = Phase.ENDED if stored.status.is_terminal else Phase.WAITING
        goal.attempt = max(stored.attempt, 1)
        goal.is_given_up = stored.is_given_up
        goal.take_origin(stored.meta)
        goal.began_at = stored.began_at or None
        return goal

    def take_origin(self, meta: Meta | None) -> None:
        """Note the origin that a meta tells; its labels count as bytes that are held."""
        self.origin = origin_in(meta)
        if self.origin.size and self.held is not None:
            self.held.resize(self.held.size + self.origin.size)

    @property
    def is_kept(self) -> bool:
        """True if this attempt is interrupted and the goal continues: see `GoalHandle.is_kept`."""
        return self.goes_on and self.status is not GoalStatus.CANCELING

    def forget_outcome(self) -> HeldBytes:
        """Forget the outcome of a goal that has ended, and return its bytes, which others may hold
        longer.
        """
        held, self.held, self.outcome = self.held, None, None
        assert held is not None
        return held

    @property
    def info(self) -> GoalInfo:
        """The goal as an entry of the status list."""
        return self.info_as(self.told_status)

    def info_as(self, status: GoalStatus) -> GoalInfo:
        """Return the goal as an entry of a list, with this status."""
        place, length = self.place if status is INITIAL else NO_PLACE
        sender, count = str(self.sender), self.feedback_count
        reason = self.suspicion if self.outcome is None else self.outcome.reason
        return GoalInfo(
            self.goal_id,
            self.stamp,
            status,
            count,
            sender,
            place,
            length,
            self.attempt,
            self.origin.parent,
            began_at=self.began_at,
            ended_at=self.ended_at or None,
            reason=reason and shortened(reason, LENGTH),
            labels=self.origin.labels or {},
        )


class Rejection(msgspec.Struct, frozen=True):
    """The record of a rejected goal."""

    digest: bytes
    reason: str
    code: RejectionCode

    def error(self, goal_id: GoalID) -> GoalRejected:
        """Return the error for the goal, and for each retry of it."""
        return GoalRejected(self.reason, goal_id=goal_id, code=self.code)


class EndKind(Enum):
    """The way in which an executor ended."""

    RESULT = "result"
    CANCELED = "canceled"
    FAILED = "failed"


class Ending(msgspec.Struct, frozen=True):
    """The end of an executor. The registry turns it into the goal's outcome."""

    kind: EndKind
    result: bytes | None = None
    reason: str = ""


class Offer(msgspec.Struct, Generic[GoalT], eq=False):
    """A goal that a client has sent."""

    sent: GoalRequest
    """The request of the client."""
    meta: dict[str, str] | None
    """A copy of its meta: the caller may change its own later."""
    request: GoalT = cast("Any", None)
    """The goal, once it is decoded."""
    context: Context | None = None
    """The context for the goal's executor; None for that of the call that accepts it."""
    goal: GoalRecord = cast("Any", None)
    """The record of the goal, once it is to be accepted."""
    is_running: bool = False
    """True if it has its turn as soon as it is accepted."""
    write: int = 0
    """The number of the write of its acceptance; 0 without a store."""
    stream: FeedbackCursor | None = None
    """The stream of the goal, once it is accepted."""
    too_large: RecordTooLarge | None = None
    """The error of a goal that the store cannot keep."""
    error: GoalRejected | None = None
    """The rejection of such a goal."""
    is_left: bool = False
    """True if the call that has sent the goal does not wait any longer."""

    def leave(self, now: float) -> None:
        """Wait no longer: the call was canceled. Its client may come back, and send it again."""
        self.is_left = True
        self.goal.remember_until = now + LEAST_TIME
        if self.stream is not None:
            self.stream.close()


AnyOffer: TypeAlias = Offer[Any]

"""`GoalRegistry`: every goal that a server knows, and what may happen to each.

Sans-I/O and synchronous: whoever drives it calls a method for what happened, passes the time as
`now=` and does what the answer says. It never waits, reads no clock, logs nothing, and knows
neither executors nor transports nor what is inside a payload.

A goal's way through it: `admit`, `accept` (or `reject`), `execute`, perhaps `cancel`, `finish`,
and at last `expire`.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterator
from enum import Enum
from typing import Generic, TypeVar

import msgspec

from fibaction.exceptions import GoalRejected
from fibaction.goals import CancelAnswer, CancelCode, GoalID, GoalInfo, Outcome
from fibaction.states import INITIAL, GoalEvent, GoalStatus, transition

T = TypeVar("T")

NO_GOAL = GoalID(bytes(16))
"""Names no goal; in a cancel it means that no goal is named."""

ID_IN_USE = "its ID is in use by another goal"


class Goal:
    """One accepted goal, as the server keeps it."""

    __slots__ = (
        "client",
        "feedback_count",
        "fingerprint",
        "goal_id",
        "outcome",
        "stamp",
        "status",
    )

    def __init__(self, goal_id: GoalID, fingerprint: int, stamp: int, client: str = "") -> None:
        self.goal_id = goal_id
        self.fingerprint = fingerprint
        self.stamp = stamp
        self.client = client
        self.status: GoalStatus = INITIAL
        self.outcome: Outcome[bytes] | None = None
        self.feedback_count = 0

    @property
    def info(self) -> GoalInfo:
        """The goal as a line of the status list."""
        return GoalInfo(self.goal_id, self.stamp, self.status, self.feedback_count, self.client)


class Admission(Enum):
    """What to do with a goal that was sent."""

    DECIDE = "decide"
    """It is new: decide, then call `accept`, `reject` or `withdraw`."""
    WAIT = "wait"
    """The same goal is being decided: ask again when that is done."""
    REPEAT = "repeat"
    """The same goal was accepted before: give the same answer again."""


class EndKind(Enum):
    """How an executor left off."""

    RESULT = "result"
    CANCELED = "canceled"
    FAILED = "failed"


class Ending(msgspec.Struct, frozen=True):
    """What an executor leaves behind; which status that is depends on the status before."""

    kind: EndKind
    result: bytes | None = None
    reason: str = ""


class _Refused(msgspec.Struct, frozen=True):
    fingerprint: int
    reason: str


class _Kept(Generic[T]):
    """Things that are remembered for the same time each, and at most so many of them."""

    def __init__(self, seconds: float, limit: int) -> None:
        self._seconds = seconds
        self._limit = limit
        self._entries: OrderedDict[GoalID, tuple[float, T]] = OrderedDict()

    def __iter__(self) -> Iterator[T]:
        return (thing for _, thing in self._entries.values())

    def put(self, goal_id: GoalID, thing: T, now: float) -> None:
        self._entries.pop(goal_id, None)  # an old entry would keep its place in the order
        self._entries[goal_id] = (now + self._seconds, thing)

    def discard(self, goal_id: GoalID) -> None:
        self._entries.pop(goal_id, None)

    def get(self, goal_id: GoalID, now: float) -> T | None:
        entry = self._entries.get(goal_id)
        return None if entry is None or entry[0] <= now else entry[1]

    def expire(self, now: float) -> list[GoalID]:
        gone: list[GoalID] = []
        while self._entries and (self.next_expiry <= now or len(self._entries) > self._limit):
            gone.append(self._entries.popitem(last=False)[0])
        return gone

    @property
    def next_expiry(self) -> float:
        # All are kept equally long, so the first to come is the first to go.
        return next(iter(self._entries.values()))[0] if self._entries else math.inf


class GoalRegistry:
    """Every goal of one action server, from its acceptance until it is forgotten."""

    def __init__(self, *, result_timeout: float = 10.0, max_results: int = 1000) -> None:
        """Start with no goals.

        `result_timeout` is how many seconds an ended goal is remembered, from its end; 0 not at
        all, `math.inf` for ever. `max_results` is how many at most: the oldest give way.
        """
        self._undecided: dict[GoalID, int] = {}
        self._active: dict[GoalID, Goal] = {}
        self._ended: _Kept[Goal] = _Kept(result_timeout, max_results)
        self._refused: _Kept[_Refused] = _Kept(result_timeout, max_results)
        self._last_stamp = 0

    # Accepting

    def admit(self, goal_id: GoalID, payload: bytes, *, now: float) -> Admission:
        """Say what to do with a goal that was sent.

        The same ID with the same payload is a client's retry, and runs once.

        Raises:
            GoalRejected: The ID names another goal, or no goal, or this goal was rejected before.
        """
        # Enough to tell a retry from a clash of IDs, and it keeps no large payload alive.
        fingerprint = hash(payload)
        if goal_id in self._undecided:
            known = self._undecided[goal_id]
            admission = Admission.WAIT
        elif (goal := self.find(goal_id, now=now)) is not None:
            known = goal.fingerprint
            admission = Admission.REPEAT
        elif (refused := self._refused.get(goal_id, now)) is not None:
            reason = refused.reason if refused.fingerprint == fingerprint else ID_IN_USE
            raise GoalRejected(reason, goal_id=goal_id)
        elif goal_id == NO_GOAL:
            raise GoalRejected("a goal ID of zeros names no goal", goal_id=goal_id)
        else:
            self._undecided[goal_id] = known = fingerprint
            admission = Admission.DECIDE
        if known != fingerprint:
            raise GoalRejected(ID_IN_USE, goal_id=goal_id)
        return admission

    def accept(self, goal_id: GoalID, *, stamp: int, client: str = "") -> Goal:
        """Take in a goal that `admit` left to decide; `client` says who sent it.

        `stamp` is the wall clock's time in nanoseconds; the goal's own stamp is later than that of
        every goal before, so that "accepted at or before" never depends on the clock's steps.
        """
        self._last_stamp = max(stamp, self._last_stamp + 1)
        goal = Goal(goal_id, self._undecided.pop(goal_id), self._last_stamp, client)
        self._ended.discard(goal_id)  # it may be one that has expired, and that nobody has missed
        self._active[goal_id] = goal
        return goal

    def reject(self, goal_id: GoalID, reason: str, *, now: float) -> None:
        """Turn away a goal that `admit` left to decide; a retry will get the same answer."""
        refused = _Refused(self._undecided.pop(goal_id), reason)
        self._refused.put(goal_id, refused, now)
        self._refused.expire(now)

    def withdraw(self, goal_id: GoalID) -> None:
        """Forget a goal that `admit` left to decide: nobody waits for the answer any more."""
        del self._undecided[goal_id]

    def is_undecided(self, goal_id: GoalID) -> bool:
        """Whether `admit` left the goal to decide, and it is not decided yet."""
        return goal_id in self._undecided

    # Running

    def execute(self, goal: Goal) -> None:
        """The goal's executor starts.

        Raises:
            InvalidTransition: The goal is not ACCEPTED.
        """
        goal.status = transition(goal.status, GoalEvent.EXECUTE)

    def finish(self, goal: Goal, ending: Ending, *, now: float) -> Outcome[bytes]:
        """The goal's executor left off; from now on the outcome is kept.

        An end by cancellation is CANCELED for a goal whose cancel was accepted, else ABORTED. Call
        `expire` afterwards: one more outcome may be one too many.

        Raises:
            InvalidTransition: The goal was never executed, and is not canceling.
        """
        event = GoalEvent.ABORT
        if ending.kind is EndKind.RESULT:
            event = GoalEvent.SUCCEED
        elif ending.kind is EndKind.CANCELED and goal.status is GoalStatus.CANCELING:
            event = GoalEvent.CANCELED
        goal.status = transition(goal.status, event)
        goal.outcome = Outcome(goal.status, ending.result, ending.reason)
        del self._active[goal.goal_id]
        self._ended.put(goal.goal_id, goal, now)
        return goal.outcome

    def cancel(self, goal_id: GoalID | None, stamp: int | None, *, now: float) -> Cancellation:
        """Begin a cancel by the rules of `action_msgs/srv/CancelGoal`.

        With neither ID nor stamp it is about all goals; with a stamp, about those accepted at or
        before it; with an ID, about that goal; with both, about that goal and those accepted at or
        before the stamp. An ID or a stamp of zeros counts as none.
        """
        if goal_id == NO_GOAL:
            goal_id = None
        if goal_id is not None and not stamp:
            goal = self.find(goal_id, now=now)
            if goal is None:
                return Cancellation((), CancelCode.UNKNOWN_GOAL_ID)
            active = (goal,) if goal.status.is_active else ()
            return Cancellation(active, CancelCode.GOAL_TERMINATED)
        latest = stamp or math.inf  # an ID alone has been dealt with
        chosen = (
            goal
            for goal in self._active.values()
            if goal.stamp <= latest or goal.goal_id == goal_id
        )
        return Cancellation(tuple(chosen), CancelCode.NONE)

    # Knowing

    def find(self, goal_id: GoalID, *, now: float) -> Goal | None:
        """The goal of that ID; None if it was never accepted or has been forgotten."""
        return self._active.get(goal_id) or self._ended.get(goal_id, now)

    def statuses(self) -> list[GoalInfo]:
        """All goals that are remembered: the ended ones in the order of their ends, then the
        active ones in the order of their acceptance.
        """
        ended = [goal.info for goal in self._ended]
        return ended + [goal.info for goal in self._active.values()]

    def expire(self, now: float) -> list[GoalID]:
        """Forget what is too old or too much, and say which goals that were."""
        self._refused.expire(now)
        return self._ended.expire(now)

    @property
    def next_expiry(self) -> float:
        """When `expire` will forget a goal; `math.inf` if it knows of none to forget."""
        return self._ended.next_expiry


class Cancellation:
    """One request to cancel, on a snapshot of the goals it is about.

    Whoever decides goes through `candidates`, and calls `accept` or `refuse` for each, in any
    order and at any time; then `answer()` is what the client is told.
    """

    def __init__(self, candidates: tuple[Goal, ...], otherwise: CancelCode) -> None:
        self.candidates = candidates
        """The goals that were active; one that is CANCELING has accepted already."""
        self._otherwise = otherwise
        self._canceling: dict[GoalID, GoalInfo] = {}
        self._reasons: list[str] = []

    def accept(self, goal: Goal) -> bool:
        """The goal agrees. False, and nothing else, if it has ended in the meantime."""
        if not goal.status.is_active:
            return False
        if goal.status is not GoalStatus.CANCELING:
            goal.status = transition(goal.status, GoalEvent.CANCEL_GOAL)
        self._canceling[goal.goal_id] = goal.info
        return True

    def refuse(self, reason: str) -> None:
        """A goal does not agree, for that reason."""
        self._reasons.append(reason)

    def answer(self) -> CancelAnswer:
        """What the client is told: NONE if any goal agreed, REJECTED if all refused."""
        canceling = tuple(
            self._canceling[goal.goal_id]
            for goal in self.candidates
            if goal.goal_id in self._canceling
        )
        if canceling:
            code = CancelCode.NONE
        elif self._reasons:
            code = CancelCode.REJECTED
        else:
            code = self._otherwise
        return CancelAnswer(code, canceling, "; ".join(dict.fromkeys(self._reasons)))

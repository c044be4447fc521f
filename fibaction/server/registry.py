"""`GoalRegistry`: every goal that a server knows, and what may happen to each.

Theory of operation
-------------------

The registry is the sans-I/O half of a server. A shell calls a method for each thing that happens,
passes the time as `now=` and acts on the answer. The registry never waits, reads no clock, logs
nothing, and knows neither executors nor transports nor the content of a payload.

A goal that was sent is in one of four places:

- *undecided*: `admit` has let it in, and `accept`, `reject` or `withdraw` must follow. Sending it
  again meanwhile gets `Verdict.WAIT`.
- *rejected*: only its digest and the reason are kept, for the result timeout, so that a retry gets
  the same answer.
- *active*: ACCEPTED, EXECUTING or CANCELING. Sending it again gets `Verdict.REPEAT`.
- *ended*: it has its outcome, and is kept for the result timeout from its end. After that its ID is
  unknown, and free.

A goal is named by the ID that its client made, and told from another goal of the same ID by the
digest of its payload. The same ID with the same digest is a retry, and runs once; with another
digest it is a clash, and is rejected.

Ending a goal has steps, so that a store can keep the outcome before anyone is told: `outcome_for`
computes the outcome and changes nothing; `finish` makes it the goal's.
"""

from __future__ import annotations

from enum import Enum

import msgspec

from fibaction.exceptions import GoalRejected
from fibaction.goals import NO_GOAL, GoalID, GoalInfo, Outcome, Sender
from fibaction.server.cancellation import Cancellation, cancellation_of
from fibaction.server.expiry import ExpiringMap
from fibaction.server.goal_record import Ending, EndKind, GoalRecord, digest_of
from fibaction.states import GoalEvent, GoalStatus, transition

ID_IN_USE = "its ID is in use by another goal"


class Verdict(Enum):
    """The next step for a goal that was sent."""

    DECIDE = "decide"
    """It is new: decide, then call `accept`, `reject` or `withdraw`."""
    WAIT = "wait"
    """The same goal is being decided: ask again when that is done."""
    REPEAT = "repeat"
    """The same goal was accepted before: give the same answer again."""


class _Rejection(msgspec.Struct, frozen=True):
    """A goal that was rejected."""

    digest: bytes
    reason: str


class GoalRegistry:
    """Every goal of one action server, from its acceptance until it is forgotten."""

    def __init__(self, *, result_timeout: float = 10.0, max_results: int = 1000) -> None:
        """Start with no goals.

        `result_timeout` is how many seconds an ended goal is remembered, from its end; 0 not at
        all, `math.inf` for ever. `max_results` is how many at most: the oldest give way.
        """
        self._undecided: dict[GoalID, bytes] = {}
        self._active: dict[GoalID, GoalRecord] = {}
        self._ended: ExpiringMap[GoalRecord] = ExpiringMap(result_timeout, max_results)
        self._rejected: ExpiringMap[_Rejection] = ExpiringMap(result_timeout, max_results)
        self._last_stamp = 0

    # Accepting

    def admit(self, goal_id: GoalID, payload: bytes, *, now: float) -> Verdict:
        """Return what to do with a goal that was sent.

        The same ID with the same payload is a client's retry, and runs once.

        Raises:
            GoalRejected: The ID names another goal, or no goal, or this goal was rejected before.
        """
        digest = digest_of(payload)
        if goal_id in self._undecided:
            known = self._undecided[goal_id]
            verdict = Verdict.WAIT
        elif (goal := self.find(goal_id, now=now)) is not None:
            known = goal.digest
            verdict = Verdict.REPEAT
        elif (rejection := self._rejected.get(goal_id, now)) is not None:
            reason = rejection.reason if rejection.digest == digest else ID_IN_USE
            raise GoalRejected(reason, goal_id=goal_id)
        elif goal_id == NO_GOAL:
            raise GoalRejected("a goal ID of zeros names no goal", goal_id=goal_id)
        else:
            self._undecided[goal_id] = known = digest
            verdict = Verdict.DECIDE
        if known != digest:
            raise GoalRejected(ID_IN_USE, goal_id=goal_id)
        return verdict

    def accept(self, goal_id: GoalID, *, stamp: int, sender: Sender) -> GoalRecord:
        """Accept a goal that `admit` left to decide.

        `stamp` is the wall clock's time in nanoseconds; the goal's own stamp is later than that of
        every goal before, so that "accepted at or before" never depends on the clock's steps.
        """
        self._last_stamp = max(stamp, self._last_stamp + 1)
        goal = GoalRecord(goal_id, self._undecided.pop(goal_id), self._last_stamp, sender)
        self._ended.discard(goal_id)  # it may have expired without being freed yet
        self._active[goal_id] = goal
        return goal

    def reject(self, goal_id: GoalID, reason: str, *, now: float) -> None:
        """Reject a goal that `admit` left to decide; a retry will get the same answer."""
        rejection = _Rejection(self._undecided.pop(goal_id), reason)
        self._rejected.put(goal_id, rejection, now)
        self._rejected.expire(now)

    def withdraw(self, goal_id: GoalID) -> None:
        """Forget a goal that `admit` left to decide; a retry of it will be new."""
        del self._undecided[goal_id]

    def is_undecided(self, goal_id: GoalID) -> bool:
        """Return whether `admit` left the goal to decide, and it is not decided yet."""
        return goal_id in self._undecided

    # Running

    def execute(self, goal: GoalRecord) -> None:
        """Move a goal to EXECUTING: its executor starts.

        Raises:
            InvalidTransition: The goal is not ACCEPTED.
        """
        goal.status = transition(goal.status, GoalEvent.EXECUTE)

    def outcome_for(self, goal: GoalRecord, ending: Ending) -> Outcome[bytes]:
        """Return the outcome of a goal whose executor left off; nothing changes yet.

        An end by cancellation is CANCELED for a goal whose cancel was accepted, else ABORTED.

        Raises:
            InvalidTransition: The goal was never executed, and is not canceling.
        """
        event = GoalEvent.ABORT
        if ending.kind is EndKind.RESULT:
            event = GoalEvent.SUCCEED
        elif ending.kind is EndKind.CANCELED and goal.status is GoalStatus.CANCELING:
            event = GoalEvent.CANCELED
        return Outcome(transition(goal.status, event), ending.result, ending.reason)

    def finish(self, goal: GoalRecord, outcome: Outcome[bytes], *, now: float, stamp: int) -> None:
        """End a goal with the outcome that `outcome_for` gave, which is kept from now on.

        `stamp` is the wall clock's time in nanoseconds. Call `expire` afterwards: one more outcome
        may be one too many.
        """
        goal.status = outcome.status
        goal.outcome = outcome
        goal.ended_at = stamp
        del self._active[goal.goal_id]
        self._ended.put(goal.goal_id, goal, now)

    def cancel(self, goal_id: GoalID | None, stamp: int | None, *, now: float) -> Cancellation:
        """Begin a cancel of the goals that an ID and a stamp mean: see `cancellation_of`."""
        return cancellation_of(
            goal_id,
            stamp,
            active=self._active.values(),
            find=lambda known: self.find(known, now=now),
        )

    # Knowing

    def find(self, goal_id: GoalID, *, now: float) -> GoalRecord | None:
        """Return the goal of that ID; None if it was never accepted or has been forgotten."""
        return self._active.get(goal_id) or self._ended.get(goal_id, now)

    def statuses(self) -> list[GoalInfo]:
        """Return all goals that are remembered: the ended ones in the order of their ends, then the
        active ones in the order of their acceptance.
        """
        ended = [goal.info for goal in self._ended]
        return ended + [goal.info for goal in self._active.values()]

    def expire(self, now: float) -> list[GoalID]:
        """Forget what is too old or too many, and return which goals that were."""
        self._rejected.expire(now)
        return self._ended.expire(now)

    @property
    def next_expiry(self) -> float:
        """The time at which `expire` will forget a goal; `math.inf` if there is none to forget."""
        return self._ended.next_expiry

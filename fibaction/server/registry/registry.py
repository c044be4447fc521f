"""`GoalRegistry`: every goal that a server knows, and the rules for each.

Theory of operation
-------------------

The registry is the sans-I/O half of a server. `Admission` and `Runs` call a method for each event,
pass the time as `now=`, and act on the answer. The registry does not wait, does not read a clock,
does not log, and does not depend on executors, transports or the content of a payload.

A goal that was sent is in one of four places:

- *undecided*: `admit` has returned `Verdict.DECIDE`, and `accept`, `reject` or `withdraw` must
  follow. Sending the goal again meanwhile gets `Verdict.WAIT`. `prepare` makes the record of a
  goal, with its stamp, before it is accepted, so that it can be written first.
- *rejected*: only its digest and the reason are kept, for the result timeout, so that a retry gets
  the same answer.
- *active*: ACCEPTED, EXECUTING or CANCELING. Sending it again gets `Verdict.REPEAT`.
- *ended*: its outcome is kept for the result timeout from its end: 10 s by default, less if there
  are more than `max_results` or too many bytes (`kept_results`), and `LEAST_TIME` (30 s) at least
  if the client may not know of it. Sending it again gets `Verdict.REPEAT`. Later its ID is free
  again.

The ID of a goal, 16 bytes and not all zero, is its client's choice. With the same payload (by its
digest) it is a retry, and runs once; with another one it is a clash, and is rejected.

A registry has two limits for all clients together: of the goals that are undecided or active, and
of the bytes that are held (`budget`): goals until they end, feedback, and results. A new goal is
counted by `admit`. If it is over a limit (`busy`), it is to be withdrawn, and rejected without a
record, since it may be accepted later. Results are forgotten to stay within the bytes (`results`).
Bytes count as long as anything references them, so nothing has to give them back.

A goal ends in two steps, so that a store can keep the outcome before it is told to clients:
`outcome_for` computes the outcome and changes nothing; `finish` makes it the goal's.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

from fibaction.border.byte_budgets import ByteBudget
from fibaction.server.registry.cancellation import Cancellation
from fibaction.server.registry.goal_record import Ending, EndKind, GoalRecord, Rejection
from fibaction.server.registry.kept_results import ExpiringMap, HeldBytes, KeptResults
from fibaction.words.errors import GoalRejected, RejectionCode
from fibaction.words.goals import ID_IN_USE, NO_GOAL, CancelCode, GoalID, Outcome, Sender, digest_of
from fibaction.words.intake import Intake, IntakeMode
from fibaction.words.statuses import GoalEvent, GoalStatus, transition

if TYPE_CHECKING:
    from fibaction.border.goal_store import StoredGoal


class IntakeRule:
    """The consequences for the goals of one server."""

    def __init__(self) -> None:
        self.holds = False
        """True if no goal begins that waits."""
        self.busy = ""
        """The reason for which new goals are rejected; empty if they are not."""

    def follow(self, intake: Intake) -> None:
        """Let goals wait, and reject new ones, by an intake."""
        self.holds = intake.mode is not IntakeMode.OPEN
        self.busy = f"busy: {intake.text_for_all}" if intake.mode is IntakeMode.REFUSE else ""


MAX_GOALS = 20_000
"""Goals that are active at the same time."""

MAX_BYTES = 256 * 2**20
"""Bytes of goals, feedback and results that are held at the same time."""

MOST_REJECTIONS = 200
"""Rejections that are forgotten by one call."""


class Verdict(Enum):
    """The next step for a goal that was sent."""

    DECIDE = "decide"
    """Decide on a new goal, then call `accept`, `reject` or `withdraw`."""
    WAIT = "wait"
    """Call `admit` again when the decision on the same goal has been made."""
    REPEAT = "repeat"
    """Give the same answer again, since the same goal was accepted before."""


class _Undecided(NamedTuple):
    """A goal that was sent, and is not decided yet."""

    digest: bytes
    held: HeldBytes


class GoalRegistry:
    """Every goal of one action server, from its acceptance until it is forgotten."""

    def __init__(
        self,
        *,
        result_timeout: float = 10.0,
        max_results: int = 1000,
        max_goals: int = MAX_GOALS,
        max_bytes: int = MAX_BYTES,
    ) -> None:
        """Make an empty registry.

        `result_timeout` is the time that an ended goal is remembered, in seconds from its end; 0
        not at all, `math.inf` forever. `max_results` is the number of ended goals that are
        remembered at most; the oldest are forgotten. `max_goals` is the number of undecided and
        active goals at most, and `max_bytes` the bytes of all that is held.
        """
        self.budget = ByteBudget(max_bytes)
        """The bytes of goals, feedback and results."""
        self.results = KeptResults(self.budget)
        """The results of ended goals, by their owners."""
        self.intake = IntakeRule()
        """The consequences of a pause."""
        self._max_goals = max_goals
        self._undecided: dict[GoalID, _Undecided] = {}
        self._active: dict[GoalID, GoalRecord] = {}
        self._ended: ExpiringMap[GoalRecord] = ExpiringMap(result_timeout, max_results)
        self._rejected: ExpiringMap[Rejection] = ExpiringMap(result_timeout, max_results)
        self._last_stamp = 0
        self._listing: tuple[GoalRecord, ...] | None = None  # the last answer of `goals`

    # Accepting

    def admit(self, goal_id: GoalID, payload: bytes, *, now: float) -> Verdict:
        """Return the next step for a goal that was sent.

        The same ID with the same payload is a client's retry, and runs once.

        Raises:
            GoalRejected: The ID is that of another goal, or all zeros, or this goal was rejected
                before.
        """
        digest = digest_of(payload)
        if goal_id in self._undecided:
            known = self._undecided[goal_id].digest
            verdict = Verdict.WAIT
        elif (goal := self.find(goal_id, now=now)) is not None:
            known = goal.digest
            verdict = Verdict.REPEAT
        elif (rejection := self._rejected.get(goal_id, now)) is not None:
            if rejection.digest == digest:
                raise rejection.error(goal_id)
            raise GoalRejected(ID_IN_USE, goal_id=goal_id, code=RejectionCode.DUPLICATE)
        elif goal_id == NO_GOAL:
            raise GoalRejected(
                "its ID is all zeros, which is reserved",
                goal_id=goal_id,
                code=RejectionCode.INVALID,
            )
        else:
            known = digest
            held = HeldBytes(self.budget, len(payload))
            self._undecided[goal_id] = _Undecided(digest, held)
            verdict = Verdict.DECIDE
        if known != digest:
            raise GoalRejected(ID_IN_USE, goal_id=goal_id, code=RejectionCode.DUPLICATE)
        return verdict

    @property
    def busy(self) -> str:
        """The reason for which a goal that was admitted last must be rejected; empty if none."""
        # Without the properties below, since it is read for each goal.
        if self.intake.busy:
            return self.intake.busy
        active = len(self._undecided) + len(self._active) - 1
        if active >= self._max_goals:
            return f"busy: {active} goals are active, the limit is {self._max_goals}"
        needed, limit = self.budget.used - self.results.size, self.budget.limit
        if needed > limit:
            return f"busy: goals and feedback would take {needed} bytes, the limit is {limit}"
        return ""

    @property
    def goals_left(self) -> int:
        """The number of goals that may be admitted in addition to those undecided or active; 0 if
        goals and feedback take too many bytes.
        """
        if self.budget.used - self.results.size > self.budget.limit:
            return 0
        return self._max_goals - len(self._undecided) - len(self._active)

    @property
    def has_too_many_bytes(self) -> bool:
        """True if goals and feedback take more bytes than the limit."""
        return self.budget.used - self.results.size > self.budget.limit

    def prepare(
        self, goal_id: GoalID, *, stamp: int, sender: Sender, deadline: float = math.inf
    ) -> GoalRecord:
        """Return the record of an undecided goal, which `accept` then takes.

        `stamp` is the wall clock's time in nanoseconds. The goal's own stamp is always later than
        that of every earlier goal, so that "accepted at or before" holds even if the clock is set
        back. `deadline` is the time, by the clock of `now`, at which the client gives up the goal.
        """
        self._last_stamp = max(stamp, self._last_stamp + 1)
        digest, held = self._undecided[goal_id]
        return GoalRecord(goal_id, digest, self._last_stamp, sender, held, deadline)

    def accept(self, goal: GoalRecord) -> None:
        """Accept an undecided goal with its record."""
        del self._undecided[goal.goal_id]
        earlier = self._ended.discard(goal.goal_id)  # it may have expired without being freed yet
        if earlier is not None:
            self._forget(earlier)
        self._active[goal.goal_id] = goal
        self._listing = None

    def restore(
        self, stored: StoredGoal, *, deadline: float = math.inf, until: float = 0.0
    ) -> GoalRecord:
        """Take a goal that was accepted by an earlier process, and return its record.

        Its outcome is remembered until the time `until`, and that of a goal that has not ended yet
        at least so long.
        """
        status = stored.status
        self._last_stamp = max(stored.stamp, self._last_stamp)
        goal_size = 0 if status.is_terminal else len(stored.goal)
        size = goal_size + stored.outcome.size
        held = HeldBytes(self.budget, size)
        goal = GoalRecord.of_stored(stored, held, deadline)
        goal_id, goal.remember_until = goal.goal_id, until
        self._listing = None
        if status.is_terminal:
            goal.status = goal.told_status = status
            goal.outcome = stored.outcome
            goal.feedback_count, goal.ended_at = stored.feedback_count, stored.ended_at
            earlier = self._ended.discard(goal_id)
            if earlier is not None:
                self._forget(earlier)
            self.results.add(goal_id, goal.sender, held, held.size)
            self._ended.put_until(goal_id, goal, until)
            return goal
        goal.stored = stored
        goal.status = goal.told_status = stored.told_status  # a status never goes back
        self._active[goal_id] = goal
        return goal

    def release(self, goal: GoalRecord) -> None:
        """Forget an active goal that ends elsewhere, or after the next start of the server."""
        del self._active[goal.goal_id]
        goal.held = None
        self._listing = None

    def reject(
        self,
        goal_id: GoalID,
        reason: str,
        code: RejectionCode = RejectionCode.REJECTED,
        *,
        now: float,
    ) -> GoalRejected:
        """Reject an undecided goal, and return the error to raise; a retry gets the same one."""
        rejection = Rejection(self._undecided.pop(goal_id).digest, reason, code)
        self._rejected.put(goal_id, rejection, now)
        self._rejected.expire(now, MOST_REJECTIONS)
        return rejection.error(goal_id)

    def withdraw(self, goal_id: GoalID) -> None:
        """Forget an undecided goal; a retry is decided again."""
        del self._undecided[goal_id]

    def is_active(self, goal_id: GoalID) -> bool:
        """Return whether the goal was accepted, and has not ended."""
        return goal_id in self._active

    def is_undecided(self, goal_id: GoalID) -> bool:
        """Return whether the goal was admitted, and is not decided yet."""
        return goal_id in self._undecided

    # Running

    def execute(self, goal: GoalRecord) -> None:
        """Move a goal to EXECUTING: its executor starts.

        Raises:
            InvalidTransition: The goal is not ACCEPTED.
        """
        goal.status = transition(goal.status, GoalEvent.EXECUTE)

    def outcome_for(self, goal: GoalRecord, ending: Ending, *, stamp: int) -> Outcome[bytes]:
        """Return the outcome of a goal whose executor has ended, without changing the goal.
        `stamp` is the time of the end by the goal's clock, in nanoseconds.

        An end by cancellation is CANCELED for a goal whose cancel was accepted, else ABORTED.

        Raises:
            InvalidTransition: The goal was never executed, and is not canceling.
        """
        event = GoalEvent.ABORT
        if ending.kind is EndKind.RESULT:
            event = GoalEvent.SUCCEED
        elif ending.kind is EndKind.CANCELED and goal.status is GoalStatus.CANCELING:
            event = GoalEvent.CANCELED
        status = transition(goal.status, event)
        return Outcome(status, ending.result, ending.reason, stamp)

    def finish(self, goal: GoalRecord, outcome: Outcome[bytes], *, now: float) -> None:
        """End a goal with the outcome that `outcome_for` returned, which is kept from now on.

        Call `expire` afterwards to keep the limit.
        """
        goal.status = goal.told_status = outcome.status
        goal.outcome = outcome
        goal.ended_at = outcome.ended_at or 0
        assert goal.held is not None
        # As `Outcome.size`, without a call for each goal.
        size = len(outcome.result or b"") + len(outcome.reason) + goal.origin.size
        self.results.add(goal.goal_id, goal.sender, goal.held, size)
        del self._active[goal.goal_id]
        self._ended.put(goal.goal_id, goal, now, at_least_until=goal.remember_until)
        self._listing = None

    def cancel(self, goal_id: GoalID | None, stamp: int | None, *, now: float) -> Cancellation:
        """Begin a cancel of the goals that an ID and a stamp mean.

        Without both it means all goals; with a stamp, those accepted at or before it; with an ID,
        that goal; with both, that goal and those accepted at or before the stamp. An ID of zeros,
        or a stamp of 0, counts as absent.
        """
        if goal_id == NO_GOAL:
            goal_id = None
        active = self._active.values()
        if stamp:
            chosen = (goal for goal in active if goal.stamp <= stamp or goal.goal_id == goal_id)
            return Cancellation(tuple(chosen), CancelCode.NONE)
        if goal_id is None:
            return Cancellation(tuple(active), CancelCode.NONE)
        goal = self.find(goal_id, now=now)
        if goal is None:
            return Cancellation((), CancelCode.UNKNOWN_GOAL_ID)
        candidates = (goal,) if goal.phase.is_open and goal.status.is_active else ()
        return Cancellation(candidates, CancelCode.GOAL_TERMINATED)

    # Queries

    def find(self, goal_id: GoalID, *, now: float) -> GoalRecord | None:
        """Return the goal of that ID; None if it was never accepted or has been forgotten."""
        return self._active.get(goal_id) or self._ended.get(goal_id, now)

    def goals(self) -> tuple[GoalRecord, ...]:
        """Return all goals that are remembered: the ended ones in the order of their ends, then the
        active ones in the order of their acceptance.

        The tuple is the same one until a goal is accepted, ends, or is forgotten.
        """
        if self._listing is None:
            self._listing = (*self._ended, *self._active.values())
        return self._listing

    def expire(self, now: float, limit: float = math.inf) -> list[GoalID]:
        """Forget what is too old, too many or too large together, and return the ended goals of it.

        At most `limit` are forgotten; then call it again.
        """
        self._rejected.expire(now, MOST_REJECTIONS)
        gone: list[GoalID] = []
        for goal in self._ended.expire(now, limit):
            self._forget(goal)
            gone.append(goal.goal_id)
        while self.budget.used > self.budget.limit and len(gone) < limit:
            large = self._ended.discard(self.results.next_to_forget())
            if large is None:
                break
            self._forget(large)
            gone.append(large.goal_id)
        return gone

    def _forget(self, goal: GoalRecord) -> None:
        """Let go of the outcome: lists of goals may reference the record for a long time."""
        held = goal.forget_outcome()
        assert held.share is not None
        held.share.forget(goal.goal_id, held)
        self._listing = None

    @property
    def next_expiry(self) -> float:
        """The time at which `expire` will forget an ended goal; `math.inf` if none has ended."""
        return self._ended.next_expiry

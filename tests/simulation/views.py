"""The goals as clients see them, compared with the facts."""

from __future__ import annotations

from fibaction import GoalID, GoalInfo, GoalStatus, Outcome
from fibaction.words.statuses import INITIAL
from tests.simulation.facts import ClientState, Truth, short
from tests.simulation.invariants import NEXT, REACHABLE, Record
from tests.simulation.scenario import Done, Step


class View:
    """One goal, as one client sees it through one stream."""

    def __init__(
        self,
        record: Record,
        client: ClientState,
        goal_id: GoalID,
        stamp: int | None,
        *,
        start: int,
        attempt: int = 0,
    ) -> None:
        """Make a view; `stamp` None means the last accepted goal with that ID. `start` is a number
        in that attempt; 0 if the attempt is not known yet.
        """
        self._record = record
        self.client = client
        self.goal_id = goal_id
        self.stamp = stamp
        self._start = start
        self._seen = 0
        self._last = start
        self._attempt = attempt
        self._dropped_before = 0
        """The number of messages that were dropped in earlier attempts."""
        self._status = INITIAL
        self.own = goal_id in client.goals
        self.losses = client.losses
        """The number of connections that the client had lost before it sent the goal."""
        self._began_at = record.now()
        self.attentive = False
        """True if it reads all feedback as soon as it arrives."""

    @property
    def name(self) -> str:
        """The short name of the goal."""
        return short(self.goal_id)

    def _fail(self, invariant: str, text: str) -> None:
        self._record.fail(invariant, f"{self.client.plan.name}, goal {short(self.goal_id)}: {text}")

    def feedback(self, step: Step, dropped: int | None, number: int | None = None) -> None:
        """Check a feedback message that was read; `dropped` is the number that it claims to have
        missed.
        """
        count = step.count
        if number is not None and number != count:
            self._fail("feedback", f"number {number} is what was yielded as {count}")
        if step.attempt != self._attempt:
            self._begin_attempt(step, dropped)
        if count <= self._last:
            self._fail("feedback", f"{count} came after {self._last}")
        self._last = count
        self._seen += 1
        dropped = None if dropped is None else dropped - self._dropped_before
        if dropped is not None and self._start + self._seen + dropped != count:
            self._fail(
                "feedback",
                f"{count} came as the {self._seen}th behind {self._start},"
                f" and {dropped} are said to be dropped",
            )
        truth = self._truth_of_attempt()
        again = self.goal_id in self._record.sent_again
        if truth is None or (count > truth.count and not again):
            self._fail("feedback", f"{count} was never yielded")

    def _begin_attempt(self, step: Step, dropped: int | None) -> None:
        """Count the feedback of another attempt anew."""
        if self._attempt:
            if step.attempt < self._attempt and self.goal_id not in self._record.sent_again:
                self._fail("feedback", f"attempt {step.attempt} came after {self._attempt}")
            self._start = self._last = self._seen = 0
            self._dropped_before = (dropped or 0) - (step.count - 1)
        self._attempt = step.attempt

    def _truth_of_attempt(self) -> Truth | None:
        truths = list(self._record.truths(self.goal_id, self.stamp))
        begun = (one for one in truths if one.starts and one.attempt == self._attempt)
        return next(begun, truths[0] if truths else None)

    def end_of_feedback(self, dropped: int) -> None:
        """Check the counts at the end of the feedback."""
        dropped -= self._dropped_before
        truth = self._record.truth(self.goal_id, self.stamp)
        if truth is not None and truth.is_restored:
            truth = self._truth_of_attempt()
            if truth is None or truth.outcome is None or not truth.starts:
                return  # the attempt that it has seen was lost
        if truth is None or truth.outcome is None:
            if self._status is not GoalStatus.UNKNOWN:
                self._fail("feedback", "it ended before the goal did")
            return
        told = self._start + self._seen + dropped
        stops = truth.life.stops_at <= self._record.now()
        if self._status is GoalStatus.UNKNOWN:
            return  # the client does not know the goal's end
        if told != truth.count and self.goal_id not in self._record.sent_again:
            self._fail(
                "feedback",
                f"{self._seen} came and {dropped} were dropped behind {self._start},"
                f" of {truth.count}" + (" (its server stops)" if stops else ""),
            )
        if dropped and self.attentive and self._may_claim_all(truth):
            self._fail("complete", f"{dropped} were dropped of {truth.count}")

    def end_of_call(self) -> None:
        """Check the end of a `call`, which does not report dropped feedback."""
        truth = self._record.truth(self.goal_id, self.stamp)
        if truth is not None and self.attentive and self._may_claim_all(truth):
            self.end_of_feedback(0)

    def _may_claim_all(self, truth: Truth) -> bool:
        # Messages that were lost with a connection are sent again, if the server remembers them.
        is_remembered = truth.count <= self._record.scenario.server.feedback_window
        was_kept = self.losses == self.client.losses and self.client.is_ready
        is_alone = self.goal_id not in self._record.sent_again
        # An executor that is interrupted while it waits for a reader, and goes on, pushes one out.
        was_left_alone = GoalStatus.CANCELING not in truth.statuses and not truth.stop_reason
        undisturbed = is_alone and was_left_alone and (was_kept or is_remembered)
        return self._record.promises_all and undisturbed

    def status(self, status: GoalStatus) -> None:
        """Check that the new status may follow the last one."""
        if status not in REACHABLE[self._status] and not (
            status is GoalStatus.UNKNOWN and self._is_forgotten()
        ):
            self._fail("status", f"{status.name} came after {self._status.name}")
        self._status = status

    def outcome(self, outcome: Outcome[Done]) -> None:
        """Check the outcome that the client received."""
        self.status(outcome.status)
        truth = self._record.truth(self.goal_id, self.stamp)
        if outcome.status is GoalStatus.UNKNOWN:
            if not self._is_forgotten():
                self._fail("outcome", "UNKNOWN, and the server must know it")
            elif self.own and self.attentive and self._record.all_ends_are_told:
                self._fail("outcome", "UNKNOWN, and the server stopped in good order")
        elif not any(
            # The second is what an error tells of it.
            outcome in (known, Outcome(known.status, known.result, known.reason))
            for known in self._record.outcomes(self.goal_id, self.stamp)
            if known is not None
        ):
            known = truth.outcome if truth is not None else None
            self._fail("outcome", f"{outcome}, and the server's is {known}")

    def _is_forgotten(self) -> bool:
        return self._record.is_forgotten(
            self.client, self.goal_id, self.stamp, own=self.own, since=self._began_at
        )


class Watch:
    """All goals as one client sees them in one stream of statuses."""

    def __init__(self, record: Record, client: ClientState, *, exact: bool) -> None:
        """Make a view; with `exact`, every change must be seen, because none can be lost."""
        self._record = record
        self._client = client
        self._known: dict[tuple[GoalID, int], GoalStatus] = {}
        self._numbers: dict[GoalID, int] = {}
        self._exact = exact

    def info(self, info: GoalInfo, *, is_known: bool) -> None:
        """Check a status; `is_known` is true if the goal had it when the stream began."""
        status = info.status
        exact = self._exact and info.goal_id not in self._record.sent_again
        if status is GoalStatus.UNKNOWN:
            for key in [key for key in self._known if key[0] == info.goal_id]:
                before = self._known.pop(key)
                if not before.is_terminal and exact:
                    self._fail(info, f"UNKNOWN came after {before.name}")
            return
        key = (info.goal_id, info.stamp)
        before_or_none = self._known.get(key)
        self._known[key] = status
        if not any(status in truth.statuses for truth in self._record.truths(*key)):
            self._fail(info, f"it never was {status.name}")
        if before_or_none is None:
            if exact and not is_known and status is not INITIAL:
                self._fail(info, f"the first that was told of it is {status.name}")
            return
        if status not in REACHABLE[before_or_none]:
            self._fail(info, f"{status.name} came after {before_or_none.name}")
        if exact and (before_or_none, status) not in NEXT:
            self._fail(info, f"{status.name} came after {before_or_none.name}, at once")

    def feedback(self, goal_id: GoalID, number: int, step: Step) -> None:
        """Check a feedback message of one of the goals."""
        about = f"{self._client.plan.name}, goal {short(goal_id)}:"
        before = self._numbers.get(goal_id, 0)
        self._numbers[goal_id] = number
        if number != step.count:
            text = f"{about} number {number} is what was yielded as {step.count}"
            self._record.fail("feedback", text)
        # It may also run again on a new server.
        runs_again = len(self._record.outcomes(goal_id, None)) > 1
        is_alone = goal_id not in self._record.sent_again and not runs_again
        if number <= before and is_alone:
            self._record.fail("feedback", f"{about} {number} came after {before}")
        has_ended = any(one[0] == goal_id and now.is_terminal for one, now in self._known.items())
        if has_ended and is_alone:
            self._record.fail("feedback", f"{about} {number} came after the end")

    def _fail(self, info: GoalInfo, text: str) -> None:
        name = self._client.plan.name
        self._record.fail("status", f"{name}, goal {short(info.goal_id)}: {text}")

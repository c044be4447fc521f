"""The rules that hold in every run, and the record that checks them.

A `Record` gets every event of servers, executors and connections (the `facts`), and adds a
`Violation` for each that breaks a rule. It never acts on the run, and never waits. `views` compares
with it what clients see of goals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import msgspec

from fibaction import (
    ActionError,
    CancelAnswer,
    CancelCode,
    ConnectionLost,
    GoalID,
    GoalRejected,
    GoalStatus,
    LimitReached,
    Outcome,
    ServerNotFound,
    UnknownGoal,
)
from fibaction.server.registry.goal_record import LEAST_TIME, GoalRecord
from fibaction.words.statuses import TRANSITIONS
from tests.simulation.facts import EPSILON, ClientState, Life, Truth, short
from tests.simulation.keeping import Keeping
from tests.simulation.places import NoPlaces, Places
from tests.simulation.scenario import ON_PURPOSE, SIMULATED, Scenario

INVARIANTS = {
    "once": "an accepted goal is executed at most once",
    "end": "an accepted goal ends exactly once, in the way that its executor did",
    "answer": "every call is answered",
    "feedback": "feedback comes in order, as it was yielded, and no gap is silent",
    "complete": "no feedback is dropped for a reader that was never late",
    "status": "a status follows another only along the edges of the table",
    "outcome": "every client is told the outcome that the server has",
    "error": "a call fails only if there is a reason",
    "cancel": "the answer to a cancel is what happens",
    "place": "no more goals run than the schedule allows, and no place is lost",
    "turn": "goals begin, and give way, as the schedule says",
    "keep": "what was told is kept, survives every crash, and never changes",
    "rest": "no task, no connection and no goal is left at the end",
    "hostile": "a hostile client gets an answer, or the end of its connection",
    "access": "a client is told, and can do, only what it is permitted",
    "held": "what is held for one client is within the limits",
    "hold": "a goal's executor waits only for the client that sent it",
    "peace": "a connection ends only if there is a reason",
    "log": "no error is logged, and no exception is lost",
}
"""The rules, by short names."""


class Violation(msgspec.Struct, frozen=True):
    """A broken rule."""

    invariant: str
    text: str
    at: float

    def __str__(self) -> str:
        return f"[{self.at:.6f}] {self.invariant} ({INVARIANTS[self.invariant]}): {self.text}"


def _decoded(outcome: Outcome[bytes]) -> Outcome[Any]:
    return outcome.decoded(SIMULATED.result.decode)


def _reachable() -> dict[GoalStatus, frozenset[GoalStatus]]:
    """Return for each status all that can come after it, directly or later, itself included."""
    edges = {(before, after) for (before, _), after in TRANSITIONS.items()}
    reach = {status: {status} for status in GoalStatus}
    for _ in GoalStatus:
        for before, after in edges:
            reach[before] |= reach[after]
    for status in GoalStatus:
        if status.is_terminal:
            reach[status].add(GoalStatus.UNKNOWN)  # for a forgotten goal
    return {status: frozenset(others) for status, others in reach.items()}


REACHABLE = _reachable()
NEXT = {(before, after) for (before, _), after in TRANSITIONS.items()}


class Record:
    """The facts and the violations of one run."""

    def __init__(self, scenario: Scenario, now: Callable[[], float]) -> None:
        self.scenario = scenario
        self.now = now
        self.trace: list[tuple[float, str]] = []
        self.violations: list[Violation] = []
        self.lives: list[Life] = []
        self.clients = {plan.name: ClientState(plan) for plan in scenario.clients}
        self.sent: list[tuple[GoalID, Any]] = []
        """Every goal that was sent, with its work."""
        self.sent_again: set[GoalID] = set()
        """The goals that were sent more than once on purpose."""
        self.clashes: set[GoalID] = set()
        """The IDs with which another goal was sent."""
        self.copied: set[GoalID] = set()
        """The goals that a hostile client has sent again."""
        self._cancels: set[GoalID | None] = set()
        self._orphaned: dict[GoalID, float] = {}
        self._outages: dict[GoalID, list[float]] = {}
        server = scenario.server
        faults = [fault.kind for fault in scenario.faults]
        self.all_ends_are_told = (
            bool(faults) and all(kind == "restart" for kind in faults) and server.store is None
        )
        """True if the only faults are restarts, before which servers tell their clients."""
        self.places = Places(self) if server.store is None else NoPlaces(self)
        self.keeping = Keeping(self)
        self.promises_all = server.feedback == "every" and scenario.climate != "rough"

    def tell(self, text: str) -> None:
        """Add an event to the trace."""
        self.trace.append((self.now(), text))

    def may_cancel(self, goal_id: GoalID | None) -> None:
        """Note that a client may cancel that goal; None is for all goals."""
        self._cancels.add(goal_id)

    def fail(self, invariant: str, text: str) -> None:
        """Add a violation."""
        assert invariant in INVARIANTS
        violation = Violation(invariant, text, self.now())
        self.violations.append(violation)
        self.tell(f"VIOLATION {violation}")

    @property
    def is_stopping(self) -> bool:
        """True if a server stops or has stopped."""
        return any(life.stops_at <= self.now() for life in self.lives)

    # What servers do

    def life_of(self, part: object) -> Life:
        """Return the server with that part."""
        return next(life for life in reversed(self.lives) if life.owns(part))

    def truth(self, goal_id: GoalID, stamp: int | None) -> Truth | None:
        """Return the facts of a goal; of the last with that ID if `stamp` is None."""
        return next(self.truths(goal_id, stamp), None)

    def outcomes(self, goal_id: GoalID, stamp: int | None) -> list[Outcome[Any] | None]:
        """Return the outcomes of the goals with that ID, several if it was sent again later."""
        return [truth.outcome for truth in self.truths(goal_id, stamp)]

    def truths(self, goal_id: GoalID, stamp: int | None) -> Iterator[Truth]:
        """Yield the goals with that ID and stamp (None for any), the last one first."""
        for life in reversed(self.lives):
            for (known, known_stamp), truth in reversed(life.goals.items()):
                if known == goal_id and stamp in (None, known_stamp):
                    yield truth

    def orphaned(self, goal_id: GoalID) -> None:
        """Note that a server has lost the client of a goal."""
        self._orphaned.setdefault(goal_id, self.now())

    def owned(self, goal_id: GoalID) -> None:
        """Note that a client follows its goal."""
        if (since := self._orphaned.pop(goal_id, None)) is not None:
            self._outages.setdefault(goal_id, []).append(self.now() - since)

    def was_orphaned_for(self, goal_id: GoalID, seconds: float) -> bool:
        """Return whether a goal was without its client for so long at a time."""
        since = self._orphaned.get(goal_id, math.inf)
        outages = [*self._outages.get(goal_id, []), self.now() - since]
        return any(outage >= seconds - EPSILON for outage in outages)

    def accepted(self, life: Life, goal_id: GoalID, stamp: int, sender: str = "") -> None:
        """Check that a goal was accepted at most once."""
        now = self.now()
        self.tell(f"server {life.number} accepts {short(goal_id)}")
        self.keeping.accepted(goal_id, stamp)
        for known in life.goals.values():
            if known.goal_id == goal_id and not self._may_run_again(known, now):
                lost = any(one.losses for one in self.clients.values() if goal_id in one.goals)
                how = "again, after its connection was lost" if lost else "twice"
                self.fail("once", f"goal {short(goal_id)} was accepted {how}")
        self._note_copy(goal_id)
        truth = life.goals[goal_id, stamp] = Truth(goal_id, stamp, life, now, sender)
        self.places.accepted(truth)

    def restored(self, life: Life, goal: GoalRecord) -> None:
        """Note a goal that a server has taken from its store."""
        self.tell(f"server {life.number} restores {short(goal.goal_id)} as {goal.status.name}")
        before = self.truth(goal.goal_id, goal.stamp)
        if before is None:  # its first server has failed before it could tell the acceptance
            self._note_copy(goal.goal_id)
        at = self.now() if before is None else before.accepted_at
        truth = Truth(goal.goal_id, goal.stamp, life, at, str(goal.sender))
        truth.goal, truth.is_restored, truth.statuses = goal, True, [goal.status]
        life.goals[goal.goal_id, goal.stamp] = truth
        if goal.status.is_terminal:
            assert goal.outcome is not None
            truth.outcome = _decoded(goal.outcome)
            truth.count, truth.ended_at = goal.feedback_count, self.keeping.ended_at(truth)
            life.ended.append(truth)
        else:
            self.places.accepted(truth)

    def _note_copy(self, goal_id: GoalID) -> None:
        """Note that a goal runs again, if it is a copied one that its server has forgotten."""
        if goal_id in self.copied and self.truth(goal_id, None) is not None:
            self.sent_again.add(goal_id)

    def _may_run_again(self, truth: Truth, now: float) -> bool:
        if not self._has_expired(truth, now):
            return False
        if truth.is_restored:
            return True  # its server has no stream for the client that has waited for it
        if truth.goal_id in self.sent_again or truth.goal_id in self.copied:
            return True
        return self.was_orphaned_for(truth.goal_id, self.scenario.server.grace)

    def changed(self, truth: Truth, status: GoalStatus) -> None:
        """Check the change of a goal's status."""
        before = truth.statuses[-1]
        if status is before or truth.life.is_dead:
            return
        self.tell(f"{short(truth.goal_id)} is {status.name}")
        if (before, status) not in NEXT:
            self.fail("status", f"a goal went from {before.name} to {status.name}")
        truth.statuses.append(status)

    def started(self, truth: Truth) -> None:
        """Check that an executor was started at most once, in one life of the server."""
        truth.starts += 1
        if truth.starts > 1:
            name = short(truth.goal_id)
            self.fail("once", f"the executor of {name} was started {truth.starts} times")
        self.places.started(truth)

    def ended(self, truth: Truth, outcome: Outcome[bytes], count: int) -> None:
        """Check the end of a goal."""
        if truth.life.is_dead:
            return
        name = short(truth.goal_id)
        self.tell(f"{name} ends {outcome.status.name} {outcome.reason} after {count}")
        if truth.outcome is not None:
            self.fail("end", f"goal {name} ended twice")
        truth.outcome = _decoded(outcome)
        result = truth.outcome.result
        truth.ended_at = self.now()
        truth.life.ended.append(truth)
        succeeded = outcome.status is GoalStatus.SUCCEEDED
        self.keeping.ended(truth)
        is_by_recovery = truth.is_restored and not truth.starts
        if is_by_recovery:
            self.keeping.ended_by_recovery(truth)
        elif succeeded != (truth.result is not None) or (succeeded and result != truth.result):
            self.fail("end", f"goal {name} ended {truth.outcome}; it had yielded {truth.result}")
        if count != truth.count:
            self.fail("feedback", f"goal {name} has yielded {truth.count}, and {count} are counted")
        asked = self._cancels & {truth.goal_id, None} or self.scenario.server.orphans == "cancel"
        if outcome.status is GoalStatus.CANCELED and not asked:
            self.fail("cancel", f"goal {name} was canceled without a request")
        self.places.ended(truth)

    # What clients see

    def is_forgotten(
        self,
        client: ClientState,
        goal_id: GoalID,
        stamp: int | None,
        *,
        own: bool,
        since: float = math.inf,
    ) -> bool:
        """Return whether the answer to a request made at `since` may be that the goal is unknown.

        `stamp` None means the last goal with that ID.
        """
        now = self.now()
        is_stopping = self.lives and self.lives[-1].stops_at <= now
        if is_stopping and not self.keeping.is_active(goal_id, stamp):
            return True
        truth = self.truth(goal_id, stamp)
        if truth is None:
            return True
        if truth.life is not self.lives[-1] or (stamp is None and truth.accepted_at >= since):
            return True
        if truth.life.began_at >= since and truth.ended_at < truth.life.began_at:
            return True  # the server before may have answered, which had forgotten the goal
        if not self._has_expired(truth, now):
            return False
        # A server keeps one stream for a client, and gives it to the next request.
        is_shared = goal_id in self.sent_again or truth.is_restored
        return not own or is_shared or self.was_orphaned_for(goal_id, self.scenario.server.grace)

    def _has_expired(self, truth: Truth, now: float) -> bool:
        server, ended = self.scenario.server, truth.life.ended
        expires_at = truth.ended_at + server.result_timeout
        if truth.is_restored:  # its client may not have been back for long
            expires_at = max(expires_at, truth.life.began_at + LEAST_TIME)
        if truth.outcome is not None and now >= expires_at - EPSILON:
            return True
        later = len(ended) - 1 - ended.index(truth) if truth in ended else 0
        return truth.outcome is not None and later >= server.max_results

    def failed(
        self,
        client: ClientState,
        error: ActionError,
        what: str,
        goal_id: GoalID | None = None,
        *,
        since: float = math.inf,
    ) -> None:
        """Check that the failure of a call that a client made at `since` has a reason."""
        text = f"{client.plan.name}: {what}: {type(error).__name__}: {error}"
        self.tell(text)
        if not self._is_excused(client, error, goal_id, since):
            self.fail("error", text)

    def _is_excused(
        self, client: ClientState, error: ActionError, goal_id: GoalID | None, since: float
    ) -> bool:
        now = self.now()
        if isinstance(error, GoalRejected):
            stops = any(life.stops_at <= now for life in self.lives)
            return (
                ON_PURPOSE in error.reason
                or (stops and "stopping" in error.reason)
                or (error.is_busy and self.places.counts["busy"] > 0)
                or (goal_id in self.clashes and "in use" in error.reason)
                or ("too much at once" in error.reason and self._is_limited)
            )
        if isinstance(error, UnknownGoal):
            # A client that attaches is a follower, even of a goal of its own.
            return goal_id is not None and self.is_forgotten(
                client, goal_id, None, own=False, since=since
            )
        # A frozen line can hold up the Hello; the server then ends the connection with its reason.
        is_late = isinstance(error, LimitReached) and "has not said hello" in str(error)
        if is_late or isinstance(error, ServerNotFound | ConnectionLost):
            if "is not running" in str(error):
                return any(life.stops_at <= now for life in self.lives)
            if self.scenario.climate == "calm":
                return client.is_leaving
            return client.is_absent(now) or client.absent_at >= since
        return "too much at once" in str(error) and self._is_limited

    @property
    def _is_limited(self) -> bool:
        return self.scenario.server.goals < 1000

    def cancel_answered(
        self, answer: CancelAnswer, goal_id: GoalID | None, asked_at: float, stamp: int | None
    ) -> None:
        """Check the answer to a cancel."""
        for info in answer.goals_canceling:
            named = self.truths(info.goal_id, info.stamp)
            if not any(GoalStatus.CANCELING in truth.statuses for truth in named):
                self.fail("cancel", f"{short(info.goal_id)} is not canceling, unlike {answer}")
        if bool(answer.goals_canceling) and answer.return_code is not CancelCode.NONE:
            self.fail("cancel", f"goals are canceling, and the answer is {answer}")
        if goal_id is None or stamp:
            return
        code = answer.return_code
        life = self.lives[-1]
        truths = [truth for (known, _), truth in life.goals.items() if known == goal_id]
        if life.began_at > asked_at or life.stops_at <= self.now() or not truths:
            return
        truth = truths[-1]
        if truth.accepted_at > asked_at:
            return
        if code is CancelCode.UNKNOWN_GOAL_ID and not self._has_expired(truth, self.now()):
            self.fail("cancel", f"{short(goal_id)} is said to be unknown")
        if code is CancelCode.GOAL_TERMINATED and truth.outcome is None:
            self.fail("cancel", f"{short(goal_id)} is said to have ended")
        if code is CancelCode.NONE and not answer.goals_canceling:
            self.fail("cancel", f"{short(goal_id)} is said to cancel, without its name")

    # At the end

    def over(self) -> None:
        """Check that all goals have ended, when the run is over."""
        self.keeping.over()
        for life in self.lives if self.scenario.server.store is None else ():
            for truth in life.goals.values():
                if truth.outcome is None:
                    self.fail("end", f"goal {short(truth.goal_id)} has not ended")

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Any, TypeVar
from unittest.mock import create_autospec

import pytest
from hypothesis import settings, strategies
from hypothesis.stateful import (
    Bundle,
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
)

from fibaction.border.abc import GoalRequest
from fibaction.border.goal_store import StoredGoal
from fibaction.feeds.feedback_log import FeedbackCursor
from fibaction.server.life import Phase
from fibaction.server.registry.cancellation import Cancellation
from fibaction.server.registry.goal_record import LEAST_TIME, Ending, EndKind, GoalRecord, Offer
from fibaction.server.registry.registry import GoalRegistry, Verdict
from fibaction.words.errors import GoalRejected, InvalidTransition, RejectionCode
from fibaction.words.goals import (
    NO_GOAL,
    UNKNOWN_SENDER,
    CancelAnswer,
    CancelCode,
    GoalID,
    GoalInfo,
    Outcome,
    Sender,
)
from fibaction.words.statuses import GoalStatus
from tests.server.held import id_of
from tests.support.matching import End

A, B, C, D = map(id_of, range(1, 5))
IN_USE = "its ID is in use by another goal"


def accepted(
    registry: GoalRegistry,
    goal_id: GoalID,
    *,
    stamp: int = 1,
    payload: bytes = b"",
    now: float = 0.0,
) -> GoalRecord:
    assert registry.admit(goal_id, payload, now=now) is Verdict.DECIDE
    goal = registry.prepare(goal_id, stamp=stamp, sender=UNKNOWN_SENDER)
    registry.accept(goal)
    return goal


def executing(registry: GoalRegistry, goal_id: GoalID, *, stamp: int = 1) -> GoalRecord:
    goal = accepted(registry, goal_id, stamp=stamp)
    registry.execute(goal)
    return goal


def canceling(registry: GoalRegistry, goal_id: GoalID, *, stamp: int = 1) -> GoalRecord:
    goal = executing(registry, goal_id, stamp=stamp)
    cancellation = registry.cancel(goal_id, None, now=0.0)
    assert cancellation.accept(goal)
    return goal


def ended(
    registry: GoalRegistry, goal_id: GoalID, *, stamp: int = 1, now: float = 0.0
) -> GoalRecord:
    goal = executing(registry, goal_id, stamp=stamp)
    finish(registry, goal, Ending(EndKind.RESULT, b"done"), now=now)
    return goal


def finish(
    registry: GoalRegistry, goal: GoalRecord, ending: Ending, *, now: float
) -> Outcome[bytes]:
    outcome = registry.outcome_for(goal, ending, stamp=100)
    assert goal.outcome is None, "nothing changes before it is kept"
    registry.finish(goal, outcome, now=now)
    assert goal.ended_at == 100
    return outcome


def infos(registry: GoalRegistry) -> list[GoalInfo]:
    return [goal.info_as(goal.status) for goal in registry.goals()]


def candidates(cancellation: Cancellation) -> list[GoalID]:
    return [goal.goal_id for goal in cancellation.candidates]


def all_accept(cancellation: Cancellation) -> CancelAnswer:
    for goal in cancellation.candidates:
        assert cancellation.accept(goal)
    return cancellation.answer()


def rejection_of(registry: GoalRegistry, goal_id: GoalID, payload: bytes, *, now: float) -> str:
    with pytest.raises(GoalRejected) as caught:
        registry.admit(goal_id, payload, now=now)
    assert caught.value.goal_id == goal_id
    return caught.value.reason


# Accepting


def test_a_goal_takes_no_more_memory_than_what_is_known_of_it_needs() -> None:
    assert not hasattr(accepted(GoalRegistry(), A), "__dict__")


def test_a_rejected_goal_sent_again_gets_the_same_reason() -> None:
    registry = GoalRegistry(result_timeout=10.0)
    registry.admit(A, b"x", now=0.0)
    error = registry.reject(A, "too far", RejectionCode.UNREADABLE, now=1.0)
    assert not registry.is_undecided(A)
    assert registry.find(A, now=1.0) is None
    with pytest.raises(GoalRejected) as caught:
        registry.admit(A, b"x", now=1.0)
    assert vars(caught.value) == vars(error)
    assert error.code is RejectionCode.UNREADABLE
    assert rejection_of(registry, A, b"x", now=10.9) == "too far"
    assert rejection_of(registry, A, b"other", now=10.9) == IN_USE


# Cancelling


def three_goals(registry: GoalRegistry) -> None:
    """A of stamp 10 is executing, B of stamp 20 is accepted, C of stamp 30 is executing."""
    executing(registry, A, stamp=10)
    accepted(registry, B, stamp=20)
    executing(registry, C, stamp=30)


def test_the_reasons_of_very_many_goals_are_cut() -> None:
    registry = GoalRegistry()
    three_goals(registry)
    cancellation = registry.cancel(None, None, now=0.0)
    for number in range(10_000):
        cancellation.reject(f"reason {number}")
    assert len(cancellation._reasons) < 200
    reason = cancellation.answer().reason
    assert reason.startswith("reason 0; reason 1; ")
    assert reason.endswith("…")
    assert len(reason) == 1000


def test_a_goal_that_another_server_takes_while_it_is_canceled_is_left_out() -> None:
    registry = GoalRegistry()
    three_goals(registry)
    of_all, of_one = registry.cancel(None, None, now=0.0), registry.cancel(A, None, now=0.0)
    taken = next(goal for goal in of_all.candidates if goal.goal_id == A)
    all_accept(of_all)
    assert of_one.accept(taken)
    for cancellation in (of_all, of_one):
        cancellation.leave_out(taken)
    assert [info.goal_id for info in of_all.answer().goals_canceling] == [B, C]
    assert of_one.answer() == CancelAnswer(CancelCode.UNKNOWN_GOAL_ID)
    undecided = registry.cancel(B, None, now=0.0)
    undecided.leave_out(undecided.candidates[0])
    assert undecided.answer() == CancelAnswer(CancelCode.UNKNOWN_GOAL_ID)


# Knowing and forgetting


def test_rejections_are_forgotten_two_hundred_at_a_time() -> None:
    registry = GoalRegistry(result_timeout=10.0)
    for number in range(1, 252):
        registry.admit(id_of(number), b"", now=0.0)
        registry.reject(id_of(number), "no", now=0.0)
    registry.expire(10.0)
    assert len(list(registry._rejected)) == 51
    registry.expire(10.0)
    assert list(registry._rejected) == []


def test_goals_are_forgotten_so_many_at_a_time_as_the_caller_says() -> None:
    registry = GoalRegistry(result_timeout=10.0, max_results=5)
    for number in range(1, 6):
        ended(registry, id_of(number), now=0.0)
        registry.admit(id_of(number + 10), b"", now=0.0)
        registry.reject(id_of(number + 10), "no", now=0.0)
    assert registry.expire(10.0, 2) == [A, B]
    assert registry.expire(10.0, 3) == [C, D, id_of(5)]
    assert registry.expire(10.0, 3) == []


@pytest.mark.promise("RESULT-4")
def test_unless_told_a_thousand_ended_goals_are_known_for_ten_seconds() -> None:
    registry = GoalRegistry()
    for number in range(1, 1003):
        ended(registry, id_of(number), now=0.0)
    assert registry.next_expiry == 10.0
    assert registry.expire(0.0) == [A, B]
    assert registry.find(C, now=9.9) is not None


# Limits


def test_unless_told_twenty_thousand_goals_and_256_mebibytes_are_the_limits() -> None:
    registry = GoalRegistry()
    assert registry.budget.limit == 256 * 1024 * 1024
    for number in range(1, 20_001):
        registry.admit(id_of(number), b"", now=0.0)
    assert registry.busy == ""
    registry.admit(id_of(20_001), b"", now=0.0)
    assert registry.busy == "busy: 20000 goals are active, the limit is 20000"


def test_the_sentence_about_bytes_does_not_count_results() -> None:
    registry = GoalRegistry(max_bytes=10)
    for one in (A, B):
        ended(registry, one)  # b"done", four bytes
    registry.admit(C, bytes(20), now=0.0)
    assert registry.busy == "busy: goals and feedback would take 20 bytes, the limit is 10"


# Random histories against a plain model


@dataclass(eq=False)
class ModelGoal:
    goal_id: GoalID
    payload: bytes
    stamp: int
    status: str = "ACCEPTED"
    outcome: tuple[bytes | None, str] | None = None
    forgotten_at: float = math.inf
    real: Any = None


@dataclass(eq=False)
class ModelCancel:
    real: Cancellation
    to_decide: list[ModelGoal]
    otherwise: str
    canceling: list[tuple[GoalID, int]] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)


@dataclass(eq=False)
class ModelRejection:
    goal_id: GoalID
    payload: bytes
    reason: str
    forgotten_at: float


Remembered = TypeVar("Remembered", ModelGoal, ModelRejection)

GOAL_IDS = [NO_GOAL, A, B, C]
PAYLOADS = [b"one", b"other"]
REASONS = ["too far", "busy"]
a_goal_id = strategies.sampled_from(GOAL_IDS)
a_payload = strategies.sampled_from(PAYLOADS)
a_reason = strategies.sampled_from(REASONS)
a_number = strategies.integers(0, 99)
an_end = strategies.sampled_from(EndKind)


class ProtocolMachine(RuleBasedStateMachine):
    """Goals and cancels in any order; after each step the registry knows what the model knows."""

    cancels: Bundle[ModelCancel] = Bundle("cancels")

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.wall = 1000
        self.undecided: dict[GoalID, bytes] = {}
        self.active: list[ModelGoal] = []
        self.ended: list[ModelGoal] = []
        self.rejections: list[ModelRejection] = []
        self.stamps: list[int] = [0]

    @initialize(
        result_timeout=strategies.sampled_from([0.0, 3.0, 10.0, math.inf]),
        max_results=strategies.sampled_from([0, 1, 2, 100]),
    )
    def start(self, result_timeout: float, max_results: int) -> None:
        self.result_timeout = result_timeout
        self.max_results = max_results
        self.registry = GoalRegistry(result_timeout=result_timeout, max_results=max_results)

    def remembered(self, things: list[Remembered], goal_id: GoalID) -> Remembered | None:
        fresh = (one for one in things if one.forgotten_at > self.now)
        return next((one for one in fresh if one.goal_id == goal_id), None)

    def known(self, goal_id: GoalID) -> ModelGoal | None:
        return self.remembered(self.active + self.ended, goal_id)

    def expected_admission(self, goal_id: GoalID, payload: bytes) -> str:
        if goal_id in self.undecided:
            return "WAIT" if self.undecided[goal_id] == payload else IN_USE
        if (goal := self.known(goal_id)) is not None:
            return "REPEAT" if goal.payload == payload else IN_USE
        if (rejection := self.remembered(self.rejections, goal_id)) is not None:
            return rejection.reason if rejection.payload == payload else IN_USE
        if not any(goal_id):
            return "its ID is all zeros, which is reserved"
        return "DECIDE"

    @rule(goal_id=a_goal_id, payload=a_payload)
    def send(self, goal_id: GoalID, payload: bytes) -> None:
        expected = self.expected_admission(goal_id, payload)
        try:
            answer = self.registry.admit(goal_id, payload, now=self.now).name
        except GoalRejected as exc:
            answer = exc.reason
        assert answer == expected
        if answer == "DECIDE":
            self.undecided[goal_id] = payload

    def any_undecided(self, number: int) -> GoalID:
        return sorted(self.undecided)[number % len(self.undecided)]

    @precondition(lambda self: self.undecided)
    @rule(number=a_number, step=strategies.integers(-50, 50))
    def accept(self, number: int, step: int) -> None:
        goal_id = self.any_undecided(number)
        self.wall += step
        goal = self.registry.prepare(goal_id, stamp=self.wall, sender=UNKNOWN_SENDER)
        self.registry.accept(goal)
        assert goal.stamp > self.stamps[-1]
        assert goal.stamp == self.wall or self.wall <= self.stamps[-1]
        self.stamps.append(goal.stamp)
        payload = self.undecided.pop(goal_id)
        # An expired goal of that ID is gone, whether or not anybody noticed.
        self.ended = [goal for goal in self.ended if goal.goal_id != goal_id]
        self.active.append(ModelGoal(goal_id, payload, goal.stamp, real=goal))

    @precondition(lambda self: self.undecided)
    @rule(number=a_number, reason=a_reason)
    def reject(self, number: int, reason: str) -> None:
        goal_id = self.any_undecided(number)
        self.registry.reject(goal_id, reason, now=self.now)
        payload = self.undecided.pop(goal_id)
        until = self.now + self.result_timeout
        self.rejections = [one for one in self.rejections if one.goal_id != goal_id]
        self.rejections.append(ModelRejection(goal_id, payload, reason, until))
        self.forget_rejections()

    @precondition(lambda self: self.undecided)
    @rule(number=a_number)
    def withdraw(self, number: int) -> None:
        goal_id = self.any_undecided(number)
        self.registry.withdraw(goal_id)
        del self.undecided[goal_id]

    @precondition(lambda self: self.active or self.ended)
    @rule(number=a_number)
    def execute(self, number: int) -> None:
        goals = self.active + self.ended
        goal = goals[number % len(goals)]
        if goal.status == "ACCEPTED":
            self.registry.execute(goal.real)
            goal.status = "EXECUTING"
        else:
            with pytest.raises(InvalidTransition):
                self.registry.execute(goal.real)

    @precondition(lambda self: self.active or self.ended)
    @rule(
        number=a_number,
        kind=an_end,
        result=strategies.sampled_from([None, b"done"]),
        reason=strategies.sampled_from(["", "stuck"]),
    )
    def finish(self, number: int, kind: EndKind, result: bytes | None, reason: str) -> None:
        goals = self.active + self.ended
        goal = goals[number % len(goals)]
        ending = Ending(kind, result, reason)
        if goal.status not in ("EXECUTING", "CANCELING"):
            with pytest.raises(InvalidTransition):
                finish(self.registry, goal.real, ending, now=self.now)
            return
        status = "ABORTED"
        if kind.name == "RESULT":
            status = "SUCCEEDED"
        elif kind.name == "CANCELED" and goal.status == "CANCELING":
            status = "CANCELED"
        outcome = finish(self.registry, goal.real, ending, now=self.now)
        goal.status = status
        goal.outcome = (result, reason)
        goal.forgotten_at = self.now + self.result_timeout
        self.active.remove(goal)
        self.ended.append(goal)
        assert outcome is goal.real.outcome

    @rule(goal_id=a_goal_id, payload=a_payload, end=strategies.booleans())
    def start_and_perhaps_end(self, goal_id: GoalID, payload: bytes, end: bool) -> None:
        """What it takes four steps to come to by chance."""
        self.send(goal_id, payload)
        if goal_id not in self.undecided:
            return
        self.accept(sorted(self.undecided).index(goal_id), 1)
        self.execute(len(self.active) - 1)
        if end:
            self.finish(len(self.active) - 1, EndKind.RESULT, b"done", "")

    @rule(
        target=cancels,
        goal_id=strategies.none() | a_goal_id,
        stamp=strategies.none() | strategies.just(0) | a_number,
        after=strategies.integers(-1, 1),
    )
    def begin_cancel(self, goal_id: GoalID | None, stamp: int | None, after: int) -> ModelCancel:
        if stamp:
            stamp = self.stamps[stamp % len(self.stamps)] + after
        cancellation = self.registry.cancel(goal_id, stamp, now=self.now)
        named = goal_id if goal_id and any(goal_id) else None
        otherwise = "NONE"
        if named is None and not stamp:
            about = list(self.active)
        elif named is None:
            about = [goal for goal in self.active if goal.stamp <= (stamp or 0)]
        elif stamp:
            about = [goal for goal in self.active if goal.stamp <= stamp or goal.goal_id == named]
        else:
            about = [goal for goal in self.active if goal.goal_id == named]
            otherwise = "UNKNOWN_GOAL_ID" if self.known(named) is None else "GOAL_TERMINATED"
        assert list(cancellation.candidates) == [goal.real for goal in about]
        return ModelCancel(cancellation, about, otherwise)

    @rule(cancel=cancels, number=a_number, agrees=strategies.booleans(), reason=a_reason)
    def decide_cancel(self, cancel: ModelCancel, number: int, agrees: bool, reason: str) -> None:
        if not cancel.to_decide:
            return
        goal = cancel.to_decide.pop(number % len(cancel.to_decide))
        if not agrees:
            cancel.real.reject(reason)
            cancel.reasons.append(reason)
        elif goal.outcome is not None:
            assert not cancel.real.accept(goal.real)
        else:
            assert cancel.real.accept(goal.real)
            goal.status = "CANCELING"
            cancel.canceling.append((goal.goal_id, goal.stamp))

    @rule(cancel=cancels)
    def answer_cancel(self, cancel: ModelCancel) -> None:
        answer = cancel.real.answer()
        in_order = sorted(cancel.canceling, key=lambda pair: pair[1])
        assert [(info.goal_id, info.stamp) for info in answer.goals_canceling] == in_order
        assert {info.status.name for info in answer.goals_canceling} <= {"CANCELING"}
        if cancel.canceling:
            assert answer.return_code.name == "NONE"
        elif cancel.reasons:
            assert answer.return_code.name == "REJECTED"
        else:
            assert answer.return_code.name == cancel.otherwise
        assert answer.reason == "; ".join(dict.fromkeys(cancel.reasons))

    @precondition(lambda self: self.active)
    @rule(number=a_number, agrees=strategies.booleans(), end=strategies.none() | an_end)
    def cancel_and_perhaps_end(self, number: int, agrees: bool, end: EndKind | None) -> None:
        """As above: five steps about one goal, which hardly ever come together by chance."""
        number %= len(self.active)
        cancel = self.begin_cancel(self.active[number].goal_id, None, 0)
        self.decide_cancel(cancel, 0, agrees, "busy")
        if end is not None:
            self.finish(number, end, b"done", "")
        self.answer_cancel(cancel)

    @rule(seconds=strategies.sampled_from([0.5, 1.0, 3.0, 10.0]))
    def time_passes(self, seconds: float) -> None:
        self.now += seconds

    def forget_rejections(self) -> None:
        self.rejections = [one for one in self.rejections if one.forgotten_at > self.now]
        self.rejections = self.rejections[max(0, len(self.rejections) - self.max_results) :]

    @rule()
    def forget(self) -> None:
        kept = [goal for goal in self.ended if goal.forgotten_at > self.now]
        kept = kept[max(0, len(kept) - self.max_results) :]
        gone = [goal.goal_id for goal in self.ended if goal not in kept]
        assert self.registry.expire(self.now) == gone
        self.ended = kept
        self.forget_rejections()

    @invariant()
    def the_lists_agree(self) -> None:
        assert infos(self.registry) == [
            GoalInfo(
                goal.goal_id,
                goal.stamp,
                GoalStatus[goal.status],
                ended_at=goal.real.ended_at or None,
                reason="" if goal.real.outcome is None else goal.real.outcome.reason,
            )
            for goal in self.ended + self.active
        ]
        assert self.registry.next_expiry == min(
            (goal.forgotten_at for goal in self.ended), default=math.inf
        )

    @invariant()
    def each_goal_is_found_as_it_is(self) -> None:
        for goal_id in GOAL_IDS:
            goal = self.known(goal_id)
            assert self.registry.find(goal_id, now=self.now) is (goal and goal.real)
            assert self.registry.is_undecided(goal_id) == (goal_id in self.undecided)

    @invariant()
    def a_goal_has_an_outcome_exactly_if_it_has_ended(self) -> None:
        for goal in self.active + self.ended:
            assert goal.real.status.name == goal.status
            assert goal.real.status.is_terminal == (goal.outcome is not None)
            expected = goal.outcome and End(GoalStatus[goal.status], *goal.outcome)
            assert goal.real.outcome == expected

    @invariant()
    def the_bytes_of_what_is_held_are_counted(self) -> None:
        held = [*self.undecided.values(), *(goal.payload for goal in self.active)]
        for goal in self.ended:
            assert goal.outcome is not None
            result, reason = goal.outcome
            held += [result or b"", reason.encode()]
        assert self.registry.budget.used == sum(map(len, held))
        assert self.registry.busy == ""

    @invariant()
    def stamps_increase(self) -> None:
        assert all(one < other for one, other in itertools.pairwise(self.stamps))


TestProtocolMachine = ProtocolMachine.TestCase
TestProtocolMachine.settings = settings(stateful_step_count=40)


# Goals of earlier processes


def stored(number: int, **fields: Any) -> StoredGoal:
    return StoredGoal(id_of(number), number, UNKNOWN_SENDER, b"", b"", **fields)


@pytest.mark.parametrize(
    ("fields", "status", "attempt"),
    [
        ({}, GoalStatus.ACCEPTED, 1),
        ({"attempt": 2}, GoalStatus.EXECUTING, 2),
        ({"attempt": 1, "status": GoalStatus.CANCELING}, GoalStatus.CANCELING, 1),
    ],
)
def test_an_active_goal_is_restored_with_the_status_that_was_told(
    fields: dict[str, Any], status: GoalStatus, attempt: int
) -> None:
    registry = GoalRegistry()
    goal = registry.restore(stored(1, **fields))
    assert (goal.status, goal.attempt, goal.phase) == (status, attempt, Phase.WAITING)
    assert registry.find(goal.goal_id, now=0.0) is goal
    registry.release(goal)
    assert registry.goals() == ()
    assert registry.budget.used == 0


def test_an_ended_goal_is_restored_with_its_outcome_until_its_time_is_over() -> None:
    registry = GoalRegistry(result_timeout=1)
    ended = stored(1, status=GoalStatus.ABORTED, result=b"x", reason="no", feedback_count=3)
    goal = registry.restore(ended, until=5.0)
    assert goal.outcome == End(GoalStatus.ABORTED, b"x", "no")
    assert (goal.phase, goal.feedback_count) == (Phase.ENDED, 3)
    assert registry.find(goal.goal_id, now=4.9) is goal
    assert registry.find(goal.goal_id, now=5.0) is None
    assert registry.expire(5.0) == [goal.goal_id]
    assert registry.budget.used == 0


def test_the_labels_of_a_goal_are_told_and_count_until_it_is_forgotten() -> None:
    registry = GoalRegistry(result_timeout=1.0)
    registry.admit(A, b"goal", now=0.0)
    goal = registry.prepare(A, stamp=1, sender=Sender())
    goal.take_origin({"order": "17", "traceparent": "00-1"})
    registry.accept(goal)
    assert (goal.info.labels, registry.budget.used) == ({"order": "17"}, 4 + 7)
    registry.finish(goal, Outcome(GoalStatus.SUCCEEDED, b"result", ended_at=2), now=0.0)
    assert (goal.info.labels, registry.budget.used) == ({"order": "17"}, 6 + 7)
    registry.expire(2.0)
    assert registry.budget.used == 0
    restored = registry.restore(stored(2, meta={"order": "18"}))
    assert (restored.info.labels, registry.budget.used) == ({"order": "18"}, 7)


def test_the_end_of_a_restored_goal_is_remembered_at_least_until_its_time() -> None:
    registry = GoalRegistry(result_timeout=1.0)
    goal = registry.restore(stored(1, attempt=1), until=50.0)
    finish(registry, goal, Ending(EndKind.RESULT, b"done"), now=0.0)
    assert registry.find(goal.goal_id, now=49.0) is goal
    assert registry.find(goal.goal_id, now=50.0) is None


def test_an_outcome_that_is_restored_again_counts_once() -> None:
    registry = GoalRegistry(result_timeout=100.0)
    ended = stored(1, status=GoalStatus.SUCCEEDED, result=b"result", reason="why")
    for _ in range(2):
        registry.restore(ended, until=5.0)
    assert len(registry.goals()) == 1
    assert not registry.is_active(id_of(1))
    registry.expire(6.0)
    assert registry.results.size == 0


@pytest.mark.parametrize("is_accepted", [True, False])
def test_an_offer_that_is_left_is_remembered_until_its_client_may_be_back(
    is_accepted: bool,
) -> None:
    offer = Offer[int](GoalRequest(id_of(1), b"1"), None)
    offer.goal = GoalRecord(id_of(1), b"", 1, UNKNOWN_SENDER)
    stream = create_autospec(FeedbackCursor, instance=True)
    offer.stream = stream if is_accepted else None
    offer.leave(5.0)
    assert (offer.is_left, offer.goal.remember_until) == (True, 5.0 + LEAST_TIME)
    assert stream.close.call_count == is_accepted

"""The contradictions that the trials of a fleet would find."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from fibaction import GoalID, GoalStatus, Outcome
from fibaction.border.goal_store import StoredGoal
from fibaction.words.goals import Sender
from tests.fleet.verdict import (
    Case,
    Rules,
    faults_of,
    faults_of_keys,
    key_pauses,
)
from tests.fleet.witness import Write
from tests.kills.ledger import Ledger
from tests.kills.victim import Done, Entry, What, Work

GOAL = GoalID(bytes(15) + b"1")
SUCCEEDED = Outcome(GoalStatus.SUCCEEDED, Done(4, 1), "")
LOST: Outcome[Done] = Outcome(GoalStatus.ABORTED, None, "the worker 'w1' was lost")
ABORT = Rules(rerun=False, lost=frozenset({"w1"}))
RERUN = Rules(rerun=True, lost=frozenset({"w1"}))
NOTHING = Rules(rerun=True)


def write(number: int, worker: str = "w1", status: GoalStatus = GoalStatus.ACCEPTED) -> Write:
    goal = StoredGoal(GOAL, 7, Sender(), b"", b"", worker=worker, status=status)
    return Write(float(number), number, number - 1, goal)


def entry(what: What, attempt: int, steps: int, at: int = 0) -> Entry:
    return Entry(at, what, str(GOAL), attempt, steps)


def faults(
    *outcomes: Outcome[Done],
    rules: Rules = NOTHING,
    diary: tuple[Entry, ...] = (),
    writes: tuple[Write, ...] | None = None,
) -> list[str]:
    ledger = Ledger()
    ledger.note_acceptance(GOAL, Work(4, 0.0), 7).outcomes += outcomes
    writes = (write(1), write(2, status=outcomes[0].status)) if writes is None else writes
    found = faults_of(Case(ledger, list(diary), list(writes), rules))
    return [fault.removeprefix(f"{GOAL} ") for fault in found]


MOVED = write(1), write(2, "w2"), write(3, "w2", GoalStatus.SUCCEEDED)
TWICE = entry("began", 1, 0), entry("kept", 1, 2), entry("began", 2, 2)


def test_a_fleet_that_keeps_its_promises_has_no_fault() -> None:
    stopped = Rules(rerun=False, released=frozenset({"w1"}))
    assert faults(SUCCEEDED, SUCCEEDED) == []
    assert faults(LOST, rules=ABORT, diary=TWICE[:1]) == []
    assert faults(SUCCEEDED, rules=RERUN, writes=MOVED, diary=TWICE) == []
    assert faults(SUCCEEDED, rules=stopped, writes=MOVED, diary=TWICE) == []


@pytest.mark.parametrize(
    ("found", "fault"),
    [
        (lambda: faults(LOST, rules=RERUN), "ended as "),
        (lambda: faults(LOST, rules=Rules(rerun=False)), "ended as "),
        (lambda: faults(SUCCEEDED, writes=(write(1),)), "was recorded as ended 0 times"),
        (lambda: faults(SUCCEEDED, writes=MOVED), "was taken from 'w1' by 'w2'"),
        (
            lambda: faults(SUCCEEDED, rules=RERUN, diary=(TWICE[0], TWICE[0])),
            "began attempt 1 after attempt 1",
        ),
        (lambda: faults(SUCCEEDED, diary=TWICE), "was run 2 times, and 1 are allowed"),
        (
            lambda: faults(SUCCEEDED, diary=(entry("stepped", 1, 1, at=3 * 10**9),)),
            "took a step after its end was recorded",
        ),
    ],
)
def test_a_broken_promise_is_found(found: Callable[[], list[str]], fault: str) -> None:
    (one,) = found()

    assert one.startswith(fault)


# Keys

SECOND = 10**9


def of_keys(*entries: tuple[float, What, int], limit: int = 1) -> Case:
    """Return a case with goals 1 and 2 of one key, and goal 3 of another."""
    ledger = Ledger()
    for number, key in ((1, 0), (2, 0), (3, 1)):
        ledger.note_acceptance(GoalID(bytes([number]) * 16), Work(4, 0.0, key=key), 7)
    diary = [
        Entry(int(at * SECOND), what, str(GoalID(bytes([number]) * 16)), 1, 0)
        for at, what, number in entries
    ]
    return Case(ledger, diary, [], Rules(rerun=True, limit=limit))


BESIDE: list[tuple[float, What, int]] = [
    (1, "began", 1),
    (2, "began", 2),
    (3, "stepped", 1),
    (4, "stepped", 2),
]


def test_a_goal_that_begins_beside_another_one_of_its_key_is_found() -> None:
    (fault,) = faults_of_keys(of_keys(*BESIDE))
    assert fault.endswith("began as one of 2 of key 0")
    assert not [*faults_of_keys(of_keys(*BESIDE, limit=2))]
    assert not [*faults_of_keys(of_keys(*BESIDE, limit=0))]


def test_the_pause_of_a_key_is_that_after_the_loss_of_the_worker_that_had_it() -> None:
    found = of_keys((1, "began", 1), (1, "began", 3), (8, "began", 2), (9, "began", 2))
    assert key_pauses(found, found.diary[:1], 2.0) == {0: 6.0}
    assert key_pauses(found, found.diary[1:2], 2.0) == {}

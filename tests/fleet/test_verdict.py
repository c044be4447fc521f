"""The contradictions that the trials of a fleet would find."""

from __future__ import annotations

from collections.abc import Callable, Iterator

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
from tests.kills.victim import TOO_HARD, Done, Entry, What, Work

GOAL = GoalID(bytes(15) + b"1")
SUCCEEDED = Outcome(GoalStatus.SUCCEEDED, Done(4, 1), "")
CANCELED = Outcome(GoalStatus.CANCELED, Done(1, 1), "")
LOST: Outcome[Done] = Outcome(GoalStatus.ABORTED, None, "the worker 'w1' was lost")
HARD = Outcome(GoalStatus.ABORTED, Done(4, 1), TOO_HARD)
ABORT = Rules(rerun=False, lost=frozenset({"w1"}))
RERUN = Rules(rerun=True, lost=frozenset({"w1"}))
NOTHING = Rules(rerun=True)


def write(
    number: int,
    worker: str = "w1",
    status: GoalStatus = GoalStatus.ACCEPTED,
    *,
    at: float = 0.0,
    replaced: int | None = None,
    is_running: bool = True,
) -> Write:
    goal = StoredGoal(GOAL, 7, Sender(), b"", b"", worker=worker, status=status)
    goal.is_running = is_running and not status.is_terminal
    return Write(at or float(number), number, number - 1 if replaced is None else replaced, goal)


def entry(what: What, attempt: int, steps: int, at: int = 0) -> Entry:
    return Entry(at, what, str(GOAL), attempt, steps)


def case(
    *outcomes: Outcome[Done],
    rules: Rules = NOTHING,
    diary: tuple[Entry, ...] = (),
    writes: tuple[Write, ...] | None = None,
    fails: bool = False,
    canceled_at: int | None = None,
) -> Callable[[], Iterator[str]]:
    ledger = Ledger()
    told = ledger.note_acceptance(GOAL, Work(4, 0.0, fails), 7)
    told.outcomes += outcomes
    told.canceled_at = canceled_at
    told.asked_to_cancel = canceled_at is not None
    if writes is None:
        status = outcomes[0].status if outcomes else GoalStatus.SUCCEEDED
        writes = (write(1), write(2, status=status))
    return lambda: faults_of(Case(ledger, list(diary), list(writes), rules))


@pytest.mark.parametrize(
    "found",
    [
        case(SUCCEEDED, SUCCEEDED),
        case(HARD, fails=True),
        case(CANCELED, canceled_at=5, diary=(entry("began", 1, 0, at=4),)),
        case(LOST, rules=ABORT, diary=(entry("began", 1, 0), entry("stepped", 1, 1))),
        case(
            SUCCEEDED,
            rules=RERUN,
            writes=(write(1), write(2, "w2"), write(3, "w2", GoalStatus.SUCCEEDED)),
            diary=(entry("began", 1, 0), entry("kept", 1, 2), entry("began", 2, 2)),
        ),
        case(
            SUCCEEDED,
            rules=Rules(rerun=False, released=frozenset({"w1"})),
            writes=(write(1), write(2, "w2"), write(3, "w2", GoalStatus.SUCCEEDED)),
            diary=(entry("began", 1, 0), entry("began", 2, 0)),
        ),
    ],
)
def test_a_fleet_that_keeps_its_promises_has_no_fault(found: Callable[[], Iterator[str]]) -> None:
    assert list(found()) == []


@pytest.mark.parametrize(
    ("found", "fault"),
    [
        (case(), "was accepted, and its end was never told"),
        (case(SUCCEEDED, LOST), "was told to have ended as"),
        (case(LOST, rules=RERUN), "was aborted: the worker 'w1' was lost"),
        (case(SUCCEEDED, writes=(write(1),)), "was recorded as ended 0 times"),
        (
            case(SUCCEEDED, writes=(write(1), write(2, "w2", GoalStatus.SUCCEEDED))),
            "was taken from 'w1' by 'w2'",
        ),
        (
            case(SUCCEEDED, rules=RERUN, diary=(entry("began", 1, 0), entry("began", 1, 0))),
            "began attempt 1 after attempt 1",
        ),
        (
            case(
                SUCCEEDED,
                rules=RERUN,
                diary=(entry("began", 1, 0), entry("began", 2, 0), entry("stepped", 1, 1)),
            ),
            "took a step in attempt 1 after attempt 2 had begun",
        ),
        (
            case(SUCCEEDED, diary=(entry("began", 1, 0), entry("began", 2, 0))),
            "was run 2 times, and 1 are allowed",
        ),
        (
            case(SUCCEEDED, diary=(entry("stepped", 1, 1, at=3 * 10**9),)),
            "took a step after its end was recorded",
        ),
    ],
)
def test_a_broken_promise_is_found(found: Callable[[], Iterator[str]], fault: str) -> None:
    (one,) = found()

    assert one.removeprefix(f"{GOAL} ").startswith(fault)


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

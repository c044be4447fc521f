"""The kills, for a short time, and the faults that they would find."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import anyio
import pytest

from fibaction import GoalID, GoalStatus, Outcome
from tests.kills.harness import run
from tests.kills.ledger import Ledger, Rules, attempts_of, faults_of
from tests.kills.victim import TOO_HARD, Diary, Done, Entry, What, Work, entries_of


@pytest.mark.promise("KEEP-1", "KEEP-2", "KEEP-3", "KEEP-4", "KEEP-5", "KEEP-6", "KEEP-7")
@pytest.mark.timeout(240)  # the calls of clients have a minute each
@pytest.mark.parametrize("recovery", ["abort", "rerun"])
def test_what_was_told_is_there_after_each_kill(tmp_path: Path, recovery: str) -> None:
    report = anyio.run(run, tmp_path, 4.0, 5, recovery, 1)

    assert report.faults == []
    assert report.kills > 0
    assert report.goals > 0


# The faults

GOAL = GoalID(bytes(15) + b"1")
SUCCEEDED = Outcome(GoalStatus.SUCCEEDED, Done(4, 1), "")
CANCELED = Outcome(GoalStatus.CANCELED, Done(1, 1), "")
RESTARTED: Outcome[Done] = Outcome(GoalStatus.ABORTED, None, "the server was restarted")
GIVEN_UP: Outcome[Done] = Outcome(
    GoalStatus.ABORTED, None, "given up after 3 attempts: the server was restarted"
)
RERUN, ABORT = Rules(rerun=True, max_attempts=3), Rules(rerun=False, max_attempts=3)


def entry(what: What, attempt: int, steps: int, at: int = 0) -> Entry:
    return Entry(at, what, str(GOAL), attempt, steps)


def faults(
    *outcomes: Outcome[Done],
    rules: Rules = RERUN,
    diary: tuple[Entry, ...] = (),
    fails: bool = False,
    canceled_at: int | None = None,
) -> list[str]:
    ledger = Ledger()
    told = ledger.note_acceptance(GOAL, Work(4, 0.0, fails), 7)
    told.outcomes += outcomes
    told.canceled_at = canceled_at
    told.asked_to_cancel = canceled_at is not None
    return [fault.removeprefix(f"{GOAL} ") for fault in faults_of(ledger, diary, rules)]


@pytest.mark.parametrize(
    "told",
    [
        lambda: faults(SUCCEEDED, SUCCEEDED),
        lambda: faults(GIVEN_UP),
        lambda: faults(RESTARTED, rules=ABORT),
        lambda: faults(CANCELED, canceled_at=5, diary=(entry("began", 1, 0, at=4),)),
        lambda: faults(SUCCEEDED, canceled_at=5),
        lambda: faults(Outcome(GoalStatus.ABORTED, Done(4, 1), TOO_HARD), fails=True),
        lambda: faults(
            SUCCEEDED, diary=(entry("began", 1, 0), entry("kept", 1, 2), entry("began", 2, 2))
        ),
        lambda: faults(
            SUCCEEDED,
            diary=(
                entry("began", 3, 0),
                entry("kept", 3, 2),
                entry("began", 5, 2),
                entry("began", 6, 3),  # it was killed between a checkpoint and its entry
                entry("began", 7, 3),
            ),
        ),
    ],
)
def test_a_server_that_keeps_its_promises_has_no_fault(told: Callable[[], list[str]]) -> None:
    assert told() == []


@pytest.mark.parametrize(
    ("told", "fault"),
    [
        (lambda: faults(), "was accepted, and its end was never told"),
        (lambda: faults(SUCCEEDED, GIVEN_UP), "was told to have ended as"),
        (lambda: faults(SUCCEEDED, fails=True), "succeeded with 4 of 4 steps"),
        (lambda: faults(CANCELED), "was canceled, and no client asked for it"),
        (lambda: faults(RESTARTED), "ended as "),
        (lambda: faults(GIVEN_UP, rules=ABORT), "ended as "),
        (lambda: faults(GIVEN_UP, canceled_at=5), "was aborted as lost, although"),
        (
            lambda: faults(Outcome(GoalStatus.ABORTED, Done(3, 1), TOO_HARD), fails=True),
            "gave up after 3 of 4 steps",
        ),
        (
            lambda: faults(SUCCEEDED, diary=(entry("began", 1, 0), entry("began", 1, 0))),
            "began attempt 1 after attempt 1",
        ),
        (
            lambda: faults(
                SUCCEEDED,
                diary=(entry("began", 1, 0), entry("began", 2, 0), entry("stepped", 1, 1)),
            ),
            "took a step in attempt 1 after attempt 2 had begun",
        ),
        (
            lambda: faults(
                SUCCEEDED, diary=(entry("began", 1, 0), entry("kept", 1, 2), entry("began", 2, 0))
            ),
            "began again with 0 steps, although 2 were kept",
        ),
        (
            lambda: faults(CANCELED, canceled_at=5, diary=(entry("began", 1, 0, at=6),)),
            "was run again, although a client was told that it is canceled",
        ),
        (
            lambda: faults(SUCCEEDED, diary=(entry("began", 4, 0),)),
            "was run again after 3 attempts were lost without progress",
        ),
        (
            lambda: faults(RESTARTED, rules=ABORT, diary=(entry("began", 2, 0),)),
            "was run again after 1 attempts were lost without progress",
        ),
    ],
)
def test_a_broken_promise_is_found(told: Callable[[], list[str]], fault: str) -> None:
    (found,) = told()

    assert found.startswith(fault)


def test_two_acceptances_of_one_goal_are_found() -> None:
    ledger = Ledger()
    ledger.note_acceptance(GOAL, Work(1, 0.0), 7)
    ledger.note_acceptance(GOAL, Work(1, 0.0), 8)

    assert ledger.faults == [f"{GOAL} was accepted at 7, and at 8"]


def test_what_is_in_the_diary_can_be_read(tmp_path: Path) -> None:
    class Goal:
        goal_id = GOAL
        attempt = 2

    diary = Diary(tmp_path / "diary")
    diary.write("began", Goal(), 3)  # type: ignore[arg-type]  # no more of a handle is needed
    diary.close()

    (read,) = entries_of(tmp_path / "diary")
    assert (read.what, read.goal_id, read.attempt, read.steps) == ("began", str(GOAL), 2, 3)
    assert attempts_of([read]) == {2: 1}

"""`fibaction.words.intake`: changes of how an action takes goals."""

from __future__ import annotations

import math

import pytest

from fibaction.words.intake import (
    MOST_CHANGES,
    MOST_GOALS,
    OPEN_INTAKE,
    Intake,
    IntakeChange,
    IntakeMode,
    ScheduleInfo,
    told_count,
    told_time,
)

AT = 1_769_860_800 * 10**9
"""2026-01-31T12:00:00Z."""
PAUSE = IntakeChange(IntakeMode.HOLD, "the floor\nis wet", "ann at here", AT)


def test_a_pause_says_since_when_by_whom_and_why() -> None:
    paused = OPEN_INTAKE.changed(PAUSE)
    assert paused.current == PAUSE
    assert paused.text == (
        r"the action is paused since 2026-01-31T12:00:00+00:00 by ann at here: the floor\x0ais wet"
    )
    assert paused.text_for_all == paused.text.replace(" by ann at here", "")
    assert Intake(IntakeMode.DRAIN).text == "the server drains"
    short = OPEN_INTAKE.changed(IntakeChange(IntakeMode.REFUSE, at=AT))
    assert short.text == "the action is paused since 2026-01-31T12:00:00+00:00"
    assert paused.changed(IntakeChange(IntakeMode.OPEN)).text == ""


def test_a_change_to_what_is_so_already_is_none_unless_it_has_another_reason() -> None:
    paused = OPEN_INTAKE.changed(PAUSE)
    assert OPEN_INTAKE.changed(IntakeChange(IntakeMode.OPEN, "again")) is OPEN_INTAKE
    assert paused.changed(IntakeChange(IntakeMode.HOLD, PAUSE.reason, "bob")) is paused
    again = paused.changed(IntakeChange(IntakeMode.HOLD, "still wet"))
    assert [change.reason for change in again.changes] == ["still wet", PAUSE.reason]


def test_a_drain_is_noted_and_changes_no_mode_and_old_changes_are_forgotten() -> None:
    intake = OPEN_INTAKE.changed(PAUSE).changed(IntakeChange(IntakeMode.DRAIN))
    assert intake.mode is IntakeMode.HOLD
    assert intake.current == PAUSE
    for number in range(MOST_CHANGES + 9):
        intake = intake.changed(IntakeChange(IntakeMode.HOLD, str(number) * 1000))
    assert len(intake.changes) == MOST_CHANGES
    assert max(len(change.reason) for change in intake.changes) == 200


@pytest.mark.parametrize(
    ("schedule", "text"),
    [
        (ScheduleInfo(max_goals=9), "all goals run at once"),
        (ScheduleInfo(concurrency=1), "1 goal runs at a time"),
        (ScheduleInfo(total=4), "4 goals run at a time"),
        (
            ScheduleInfo(concurrency=1, total=4, queue=9, is_keyed=True, has_priority=True),
            (
                "1 goal runs at a time for each key, 4 in total; 9 may wait for each key, the most"
                " urgent first"
            ),
        ),
        (
            ScheduleInfo(concurrency=2, queue=1, queue_timeout=30, when_full="replace"),
            (
                "2 goals run at a time; 1 may wait for 30 s at most; a new goal replaces the newest"
                " that waits"
            ),
        ),
        (
            ScheduleInfo(concurrency=2, queue=1, fleet_limit="arm\n1"),
            r"2 goals run at a time at all workers together (arm\x0a1); 1 may wait",
        ),
        (
            ScheduleInfo(concurrency=1, run_timeout=0.5, when_full="preempt"),
            (
                "1 goal runs at a time; each runs for 0.5 s at most; a new goal ends the one that"
                " has run longest"
            ),
        ),
        (ScheduleInfo(when_full="of a later version"), "all goals run at once"),
    ],
)
def test_the_limits_are_a_phrase(schedule: ScheduleInfo, text: str) -> None:
    assert schedule.text == text


def test_what_is_beyond_all_limits_is_told_as_the_largest_or_as_none() -> None:
    assert [told_count(limit) for limit in (None, 7, 2**99)] == [None, 7, MOST_GOALS]
    assert [told_time(seconds) for seconds in (0, 1e9, 10**400, math.inf)] == [0, 1e9, None, None]

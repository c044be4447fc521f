"""`fibaction.words.intake`: changes of how an action takes goals."""

from __future__ import annotations

from fibaction.words.intake import MOST_CHANGES, OPEN_INTAKE, Intake, IntakeChange, IntakeMode

AT = 1_769_860_800 * 10**9
"""2026-01-31T12:00:00Z."""
PAUSE = IntakeChange(IntakeMode.HOLD, "the floor\nis wet", "ann at here", AT)


def test_a_pause_says_since_when_by_whom_and_why() -> None:
    paused = OPEN_INTAKE.changed(PAUSE)
    assert paused.current == PAUSE
    assert paused.text == (
        r"the action is paused since 2026-01-31T12:00:00+00:00 by ann at here: the floor\x0ais wet"
    )
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

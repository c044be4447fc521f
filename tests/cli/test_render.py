"""A goal's story in words and in JSON."""

from __future__ import annotations

import json
import sys
from collections.abc import AsyncGenerator

import anyio
import pytest

from fibaction import (
    Action,
    ActionServer,
    GoalHandle,
    GoalID,
    GoalRejected,
    GoalStatus,
    Outcome,
    RejectionCode,
    connect,
    serve,
)
from fibaction.border.abc import FeedbackItem
from fibaction.cli.output.render import CODES, JsonPrinter, TextPrinter, goal_printer, print_goal
from fibaction.testing import ScriptedServer
from fibaction.words.goals import UNKNOWN_OUTCOME

GOAL_ID = GoalID.parse("0123456789abcdef0123456789abcdef")
COUNT: Action[int, int, str] = Action("count", goal=int, feedback=int, result=str)
PLAIN = Action.untyped(COUNT.info)


def test_in_words_reasons_are_told_and_cleaned(capsys: pytest.CaptureFixture[str]) -> None:
    words = TextPrinter()
    words.rejected(GoalRejected("too hot\x1b"))
    words.rejected(GoalRejected(""))
    words.ended(Outcome(GoalStatus.ABORTED, reason="no\nway"))
    words.ended(UNKNOWN_OUTCOME)

    assert capsys.readouterr().out.splitlines() == [
        "Goal was rejected: too hot\\x1b",
        "Goal was rejected.",
        "Goal finished with status: ABORTED (no\\x0away)",
        f"Goal finished with status: UNKNOWN ({UNKNOWN_OUTCOME.reason})",
    ]


def test_in_json_each_event_is_an_object(capsys: pytest.CaptureFixture[str]) -> None:
    told = goal_printer(feedback=True, as_json=True, full=False)
    told.sending({"order": 1})
    told.accepted(GOAL_ID, 5)
    told.rejected(GoalRejected("no", goal_id=GOAL_ID, code=RejectionCode.BUSY))
    told.status(GoalStatus.EXECUTING)
    told.feedback(FeedbackItem(1, b"", at=7), [0])
    JsonPrinter(feedback=False).feedback(FeedbackItem(2, b""), [0])
    told.ended(Outcome(GoalStatus.CANCELED, [0], "asked"))

    assert [json.loads(line) for line in capsys.readouterr().out.splitlines()] == [
        {"event": "accepted", "goal_id": str(GOAL_ID), "stamp": 5},
        {"event": "rejected", "goal_id": str(GOAL_ID), "reason": "no", "code": "BUSY"},
        {"event": "status", "status": "EXECUTING"},
        {"event": "feedback", "number": 1, "at": 7, "feedback": [0]},
        {"event": "result", "status": "CANCELED", "result": [0], "reason": "asked"},
    ]


def test_every_end_of_a_goal_has_its_exit_code() -> None:
    assert set(CODES) == {status for status in GoalStatus if not status.is_active}
    assert CODES[GoalStatus.SUCCEEDED] == 0


async def told_of(server: ActionServer[int, int, str], *, live: bool = False) -> int:
    """Follow a goal of that server."""
    async with serve(server, "inproc://telling"), connect("inproc://telling") as connection:
        payload = PLAIN.goal.encode(1)
        stream = await connection.endpoint(PLAIN).send_goal(GOAL_ID, payload)
        with anyio.fail_after(10):
            return await print_goal(stream, PLAIN, JsonPrinter(feedback=True), live=live)


async def quick(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    for number in range(100):
        yield number
    yield "done"


@pytest.mark.asyncio
async def test_feedback_that_was_missed_is_told_of(capsys: pytest.CaptureFixture[str]) -> None:
    await told_of(ActionServer(COUNT, quick, feedback="latest", feedback_window=1))

    assert " feedback messages were missed: they came" in capsys.readouterr().err


@pytest.mark.asyncio
async def test_on_a_terminal_the_feedback_is_on_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "80")
    async with (
        serve(ScriptedServer(COUNT, [1, 2, "done"]), "inproc://live"),
        connect("inproc://live") as connection,
    ):
        stream = await connection.endpoint(PLAIN).send_goal(GOAL_ID, PLAIN.goal.encode(1))
        await print_goal(stream, PLAIN, TextPrinter(), live=True)

    out = capsys.readouterr().out
    assert "Feedback:" not in out
    assert "feedback 2" in out
    assert out.endswith("Goal finished with status: SUCCEEDED\n")

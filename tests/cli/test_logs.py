"""The log on stderr: clean lines, with the time, from the level that is wanted."""

from __future__ import annotations

import json
import logging
import re

import pytest

from fibaction import GoalID
from fibaction.cli.process.logs import CleanFormatter, log_events, log_with_time
from fibaction.words.goals import CurrentGoal, current_goal


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("fibaction.wire", "log: gone\\x0a\\x1b[2J"),
        ("fibaction_transports.tcp", "log: gone\\x0a\\x1b[2J"),
        ("robot", "log: gone\n\x1b[2J"),
    ],
)
def test_records_of_fibaction_are_cleaned_and_those_of_the_user_are_not(
    name: str, line: str
) -> None:
    record = logging.makeLogRecord({"name": name, "msg": "%s", "args": ("gone\n\x1b[2J",)})

    assert CleanFormatter("log: %(message)s").format(record) == line


def test_a_traceback_in_the_log_keeps_its_lines_and_is_cleaned() -> None:
    error = ZeroDivisionError("by nothing\x1b[2J\nat all")
    record = logging.makeLogRecord(
        {"name": "fibaction", "msg": "it failed", "exc_info": (type(error), error, None)}
    )

    assert (
        CleanFormatter().format(record)
        == "it failed\n  ZeroDivisionError: by nothing\\x1b[2J\n  at all"
    )


def test_events_are_logged_with_their_time_and_the_log_is_restored(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    root, files = logging.getLogger(), logging.getLogger("watchfiles")
    monkeypatch.setattr(files, "level", logging.NOTSET)
    before = (root.level, root.handlers[:])
    with log_with_time():
        logging.getLogger("fibaction.any").info("nothing is served yet")
        log_events()
        logging.getLogger("fibaction.any").info("an event\x1b")
        files.warning("1 change detected")
        (line,) = capsys.readouterr().err.splitlines()

    assert (root.level, root.handlers, files.level) == (*before, logging.NOTSET)
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} an event\\x1b", line)


def test_records_are_json_objects_with_their_goal_if_that_is_wanted(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with log_with_time(as_json=True):
        current = current_goal.set(CurrentGoal("drive", GoalID(bytes(16))))
        logging.getLogger("robot").warning("stuck")
        current_goal.reset(current)

    fields = json.loads(capsys.readouterr().err)
    assert (fields["message"], fields["action"], fields["goal_id"]) == ("stuck", "drive", "0" * 32)

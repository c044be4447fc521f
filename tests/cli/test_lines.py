"""Lines on stdout and stderr: output, remarks, JSON, and the log."""

from __future__ import annotations

import io
import json
import logging
import re
import sys
from contextlib import redirect_stderr

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from rich.file_proxy import FileProxy

from fibaction import GoalID
from fibaction.cli.output import lines
from fibaction.cli.output.lines import CleanFormatter, log_events, log_with_time
from fibaction.cli.process.exit_codes import ExitCode, Failure
from fibaction.words.goals import CurrentGoal, current_goal


@given(st.text() | st.dictionaries(st.text(), st.lists(st.text())))
def test_json_of_any_text_is_one_line_that_cannot_control_the_terminal(value: object) -> None:
    text = lines.as_json(value)

    assert text.isprintable()
    assert json.loads(text) == value


def test_a_value_beyond_json_is_an_error_in_one_sentence() -> None:
    with pytest.raises(Failure, match="cannot be written as JSON: ") as failure:
        lines.as_json(object())

    assert failure.value.exit_code == ExitCode.ABORTED


def test_a_remark_with_text_of_a_server_stays_on_one_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines.note("it is away: gone\n\x1b[2J")

    assert capsys.readouterr().err == "it is away: gone\\x0a\\x1b[2J\n"


def test_remarks_and_the_log_go_through_the_stderr_of_a_line_that_is_drawn_again() -> None:
    handler = lines.LogHandler()
    handler.setFormatter(logging.Formatter("log: %(message)s"))
    drawn = io.StringIO()
    with redirect_stderr(FileProxy(Console(file=drawn), sys.stderr)):
        handler.handle(logging.makeLogRecord({"msg": "the line is dead"}))
        lines.note("it is away")

    assert drawn.getvalue() == "log: the line is dead\nit is away\n"


def test_only_a_capable_terminal_counts_as_one(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("FORCE_COLOR", "TTY_COMPATIBLE", "NO_COLOR"):
        monkeypatch.delenv(name, raising=False)
    assert not lines.on_terminal()

    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "dumb")
    assert not lines.on_terminal()

    monkeypatch.setenv("TERM", "xterm-256color")
    assert lines.on_terminal()
    assert lines.console().color_system is not None

    monkeypatch.setenv("NO_COLOR", "1")
    assert lines.console().no_color


def test_text_of_others_is_not_markup(capsys: pytest.CaptureFixture[str]) -> None:
    lines.console().print("[red]x[/red] :smile: 12")

    assert capsys.readouterr().out == "[red]x[/red] :smile: 12\n"


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

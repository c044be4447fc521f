from __future__ import annotations

import io
import json
import logging
import sys
from contextlib import redirect_stderr

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fibaction.cli.output import lines
from fibaction.cli.process.exit_codes import ExitCode, Failure


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


def test_the_log_goes_to_the_stderr_of_that_moment() -> None:
    handler = lines.LogHandler()
    handler.setFormatter(logging.Formatter("log: %(message)s"))
    later = io.StringIO()
    with redirect_stderr(later):
        handler.handle(logging.makeLogRecord({"msg": "the line is dead"}))

    assert later.getvalue() == "log: the line is dead\n"


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

"""What a server says cannot control the terminal."""

from __future__ import annotations

import json
import logging

import pytest

from fibaction.cli.escaping import CleanFormatter, clean, clean_json


def test_text_of_others_is_cleaned() -> None:
    assert clean("ok\n\x1b[2J\u2028\U000e0001") == "ok\\x0a\\x1b[2J\\u2028\\U000e0001"
    assert clean("füñf 鳥") == "füñf 鳥"


def test_what_is_clean_stays_as_it_is() -> None:
    assert clean(clean("\x1b")) == clean("\x1b")


def test_json_is_cleaned_in_the_way_of_json() -> None:
    said = "ok \x7f\x9b2J\u202e\U000e0001 füñf 鳥"
    text = json.dumps(said, ensure_ascii=False)

    assert clean_json(text) == r'"ok \u007f\u009b2J\u202e\udb40\udc01 füñf 鳥"'
    assert json.loads(clean_json(text)) == said


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("fibaction.wire", "log: gone\\x0a\\x1b[2J"),
        ("fibaction_transports.tcp", "log: gone\\x0a\\x1b[2J"),
        ("robot", "log: gone\n\x1b[2J"),
    ],
)
def test_the_log_is_cleaned_of_what_a_peer_said_and_not_of_what_the_user_writes(
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
        == "it failed\nZeroDivisionError: by nothing\\x1b[2J\nat all"
    )

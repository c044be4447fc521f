"""Values as text: YAML that can be read again, JSON, and nothing that controls the terminal."""

from __future__ import annotations

import datetime
import io
import json
import logging
import math
import sys
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from msgspec.msgpack import Ext

from fibaction.cli import output
from fibaction.cli.exit_codes import Failure

# What msgpack carries: text without lone surrogates, integers of 64 bits.
scalars = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False)
    | st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
    | st.binary(max_size=20)
)
keys = st.text(st.characters(exclude_categories=["Cs"]), max_size=10) | st.integers(-9, 9)
values: st.SearchStrategy[Any] = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(keys, inner, max_size=5),
    max_leaves=30,
)


@given(values)
def test_what_is_printed_is_yaml_of_the_value(value: Any) -> None:
    assert yaml.safe_load(output.as_yaml(value)) == value


@given(st.text() | st.lists(st.text(), max_size=3) | st.dictionaries(st.text(), st.text()))
def test_no_text_can_control_the_terminal(value: Any) -> None:
    assert all(c.isprintable() or c == "\n" for c in output.as_yaml(value))


@given(values)
def test_no_text_can_control_the_terminal_from_json_either(value: Any) -> None:
    assert output.as_json(value).isprintable()


@given(st.dictionaries(st.text(max_size=3), st.text() | st.integers(-(2**63), 2**64 - 1)))
def test_what_is_printed_as_json_is_the_value(value: Any) -> None:
    assert json.loads(output.as_json(value)) == value


def test_it_looks_as_ros_prints_it() -> None:
    value = {
        "order": 3,
        "name": "a b",
        "done": True,
        "nothing": None,
        "numbers": [0, 1],
        "pose": {"x": 1.5, "y": 2.0, "frame": "map"},
        "points": [{"x": 1, "tags": ["a"]}, [1, 2]],
        "empty": [],
        "none": {},
    }

    assert output.as_yaml(value, indent=4).splitlines() == [
        "    order: 3",
        "    name: a b",
        "    done: true",
        "    nothing: null",
        "    numbers:",
        "    - 0",
        "    - 1",
        "    pose:",
        "      x: 1.5",
        "      y: 2.0",
        "      frame: map",
        "    points:",
        "    - x: 1",
        "      tags:",
        "      - a",
        "    - - 1",
        "      - 2",
        "    empty: []",
        "    none: {}",
    ]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (math.nan, ".nan"),
        (math.inf, ".inf"),
        (-math.inf, "-.inf"),
        (1e300, "1.0e+300"),
        (1.5e-7, "1.5e-07"),
        ("yes", '"yes"'),
        ("12", '"12"'),
        ("füñf", "füñf"),
        ("鳥", "鳥"),
        ("a: b", '"a: b"'),
        ("\x1b[31m\x9b\u202e", '"\\u001b[31m\\x9b\\u202e"'),
        ("\U000e0001", '"\\U000e0001"'),
        (b"hi", '!!binary "aGk="'),
        (datetime.datetime(2026, 1, 2, 3, tzinfo=datetime.UTC), "2026-01-02T03:00:00+00:00"),
        (Ext(5, b"x"), '"extension 5: eA=="'),
        ((1, 2), "- 1\n- 2"),
        ({(1, 2): 3}, '"(1, 2)": 3'),
    ],
)
def test_each_kind_of_value_has_its_text(value: object, text: str) -> None:
    assert output.as_yaml(value) == text


def test_a_long_list_is_cut_and_says_so() -> None:
    text = output.as_yaml({"numbers": list(range(50_000))})

    assert text.splitlines()[-2:] == ["- 127", "# ... and 49872 more"]
    assert yaml.safe_load(text) == {"numbers": list(range(128))}


def test_long_text_and_bytes_are_cut_and_say_so() -> None:
    text = output.as_yaml(["x" * 5_000_000, b"x" * 1001])

    assert text.splitlines()[0].endswith('x"  # ... and 4999000 more characters')
    assert text.splitlines()[1].endswith('"  # ... and 1 more bytes')
    assert yaml.safe_load(text) == ["x" * 1000, b"x" * 1000]


def test_in_full_nothing_is_cut() -> None:
    value = {"numbers": list(range(1000)), "text": "x" * 5000, "bytes": b"x" * 5000}

    assert yaml.safe_load(output.as_yaml(value, full=True)) == value


def test_a_value_that_is_too_deep_ends_somewhere() -> None:
    value: list[Any] = []
    for _ in range(500):
        value = [value]

    assert output.as_yaml(value).endswith("null  # ... there is more, deeper than 50 levels")


def test_json_is_one_line_with_base64_and_iso_times(capsys: pytest.CaptureFixture[str]) -> None:
    time = datetime.datetime(2026, 1, 2, 3, tzinfo=datetime.UTC)
    output.say_json({"a": [1, 2.5, None], "b": b"hi", "t": time, "e": Ext(5, b"x"), "ü": math.nan})

    out = capsys.readouterr().out
    assert out.count("\n") == 1
    assert json.loads(out) == {
        "a": [1, 2.5, None],
        "b": "aGk=",
        "t": "2026-01-02T03:00:00Z",
        "e": {"ext": 5, "data": "eA=="},
        "ü": None,
    }


@pytest.mark.parametrize("value", [{(1, 2): 3}, object()])
def test_what_json_cannot_express_is_one_sentence(value: object) -> None:
    with pytest.raises(Failure, match="it cannot be written as JSON: "):
        output.as_json(value)


def test_lines_go_to_stdout_and_remarks_to_stderr(capsys: pytest.CaptureFixture[str]) -> None:
    output.say("line")
    output.say()
    output.note("remark")

    assert capsys.readouterr() == ("line\n\n", "remark\n")


def test_a_remark_with_the_words_of_a_server_stays_one_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    output.note("it is away: gone\n\x1b[2J")

    assert capsys.readouterr().err == "it is away: gone\\x0a\\x1b[2J\n"


def test_the_log_goes_where_stderr_is_by_then(monkeypatch: pytest.MonkeyPatch) -> None:
    handler = output.LogHandler()
    handler.setFormatter(logging.Formatter("log: %(message)s"))
    later = io.StringIO()
    monkeypatch.setattr(sys, "stderr", later)
    handler.handle(logging.makeLogRecord({"msg": "the line is dead"}))

    assert later.getvalue() == "log: the line is dead\n"


def test_nothing_but_a_terminal_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("FORCE_COLOR", "TTY_COMPATIBLE", "NO_COLOR"):
        monkeypatch.delenv(name, raising=False)
    assert not output.on_terminal()

    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "dumb")
    assert not output.on_terminal()

    monkeypatch.setenv("TERM", "xterm-256color")
    assert output.on_terminal()
    assert output.console().color_system is not None

    monkeypatch.setenv("NO_COLOR", "1")
    assert output.console().no_color


def test_what_others_have_written_is_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    output.console().print("[red]x[/red] :smile: 12")

    assert capsys.readouterr().out == "[red]x[/red] :smile: 12\n"

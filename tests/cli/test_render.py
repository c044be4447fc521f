"""A goal's story in words, in JSON, in YAML, and on the live line."""

from __future__ import annotations

import datetime
import io
import json
import math
import sys
from collections.abc import AsyncGenerator
from contextlib import redirect_stderr
from typing import Any

import anyio
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from msgspec.msgpack import Ext
from rich.console import Console

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
from fibaction.cli.output import yaml_text
from fibaction.cli.output.lines import note
from fibaction.cli.output.progress import (
    LiveLine,
    on_one_line,
    percent_bar,
    text_beside_bar,
)
from fibaction.cli.output.render import CODES, JsonPrinter, TextPrinter, goal_printer, print_goal
from fibaction.cli.output.yaml_text import as_yaml
from fibaction.testing import ScriptedServer
from fibaction.words.goals import UNKNOWN_OUTCOME
from fibaction.words.progress import Progress

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


@pytest.mark.parametrize(
    ("feedback", "line"),
    [
        ({"a": 1, "b": "x y", "c": None}, "a: 1  b: x y  c: null"),
        ({"pose": {"x": 0.1234567891}}, "pose: {x: 0.123457}"),
        (
            {"n": list(range(50_000))},
            "n: [..., 49992, 49993, 49994, 49995, 49996, 49997, 49998, 49999]",
        ),
        ({"n": [1, 2], "yes": [True, False]}, "n: [1, 2]  yes: [true, false]"),
        ("red\x1b[31m\nüñ", "red\\x1b[31m\\x0aüñ"),
        ("x" * 1000, "x" * 500),
        ({"a": {1}, 5: ()}, "a: [1]  5: []"),
        ([[1], {"a": 2}], "[[1], {a: 2}]"),
        (b"hi", "b'hi'"),
        ({f"{n}": n for n in range(9999)}, "  ".join([*(f"{n}: {n}" for n in range(200)), "..."])),
    ],
)
def test_a_feedback_is_made_one_line(feedback: object, line: str) -> None:
    assert on_one_line(feedback) == line


def test_the_line_of_a_hostile_feedback_is_short() -> None:
    wide: Any = {"x" * 1000: 1}
    for _ in range(8):
        wide = [wide] * 8
    deep: Any = []
    for _ in range(5000):
        deep = [deep]
    for feedback in (wide, deep, {"a": wide, "b": wide}, {f"{n}": [n] * 9 for n in range(300)}):
        assert len(on_one_line(feedback)) < 200_000

    assert on_one_line(deep) == "[" * 22 + "..." + "]" * 22


def test_the_text_beside_a_bar_has_the_counts_and_what_else_there_is() -> None:
    copied = {"done": 3, "total": 10, "text": "a\nb", "speed": 2}
    whole = text_beside_bar(copied, Progress(3, 10, "a\nb"), ("done", "total"))
    assert whole == "3/10 a\\x0ab  speed: 2"
    assert text_beside_bar({"percent": 5, "n": 1}, Progress(5, 100), ("percent",)) == "n: 1"
    assert text_beside_bar({"percent": 5}, Progress(5, 100), ("percent",)) == ""


def drawn(feedback: Any, width: int = 80) -> str:
    """What the line consists of, without colours."""
    output = io.StringIO()
    console = Console(file=output, width=width, force_terminal=True, color_system=None)
    with LiveLine(console) as line:
        if feedback is not None:
            line.show(7, feedback)
    return output.getvalue()


@pytest.mark.parametrize("width", [80, 160])
def test_the_line_has_a_bar_where_the_feedback_tells_how_far(width: int) -> None:
    text = drawn({"progress": 0.5, "step": "x" * 200}, width)

    assert "━" * (width // 8) in text
    assert " 50%  step: x" in text, "what the bar tells is not told again"
    assert "…" in text  # and so it is one line
    assert "x" * (width - width // 4 - 30) in text


def test_the_line_counts_where_it_does_not() -> None:
    assert "feedback 7  numbers: [1, 2]" in drawn({"numbers": [1, 2]})


def test_before_the_first_feedback_it_says_so() -> None:
    assert "waiting for feedback" in drawn(None)


def test_a_narrow_bar_is_the_percent_only() -> None:
    assert percent_bar(0.5, 0).plain == " 50%"
    assert percent_bar(0.25, 2).plain == "╸─  25%"


class Tty(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("errors", [Tty(), io.StringIO()], ids=["terminal", "file"])
def test_a_remark_is_above_the_line_unless_it_goes_to_a_file(errors: io.StringIO) -> None:
    screen = io.StringIO()
    console = Console(file=screen, width=80, force_terminal=True, color_system=None)
    with redirect_stderr(errors), LiveLine(console):
        note("a remark")

    above, other = (screen, errors) if errors.isatty() else (errors, screen)
    assert "a remark\n" in above.getvalue()
    assert "a remark" not in other.getvalue()


def test_the_line_is_gone_in_the_end() -> None:
    assert drawn({"n": 1}).endswith("\x1b[2K")  # which erases a line


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
def test_any_value_is_read_again_from_its_yaml(value: Any) -> None:
    assert yaml.safe_load(as_yaml(value)) == value


@given(st.text() | st.lists(st.text(), max_size=3) | st.dictionaries(st.text(), st.text()))
def test_no_text_can_control_the_terminal(value: Any) -> None:
    assert all(c.isprintable() or c == "\n" for c in as_yaml(value))


def test_a_message_looks_as_ros_prints_it() -> None:
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

    assert as_yaml(value, indent=4).splitlines() == [
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
        ("yes", "'yes'"),
        ("y", "y"),
        ("12", "'12'"),
        ("füñf 鳥 🤖", "füñf 鳥 🤖"),
        ("a: b", "'a: b'"),
        ("two\nlines", '"two\\nlines"'),
        ("\x1b[31m\x9b\u202e", '"\\e[31m\\x9B\\u202e"'),
        ("\U000e0001", '"\\U000E0001"'),
        (b"hi", '!!binary "aGk="'),
        (datetime.datetime(2026, 1, 2, 3, tzinfo=datetime.UTC), "2026-01-02 03:00:00+00:00"),
        (Ext(5, b"x"), "'extension 5: eA=='"),
        ((1, 2), "- 1\n- 2"),
        ({(1, 2): 3}, "(1, 2): 3"),
    ],
)
def test_each_kind_of_value_has_its_text(value: object, text: str) -> None:
    assert as_yaml(value) == text


def test_an_object_that_appears_twice_is_written_twice() -> None:
    time = datetime.datetime(2026, 1, 2)

    assert as_yaml([time, time]).splitlines() == ["- 2026-01-02 00:00:00"] * 2


def test_long_lists_texts_and_bytes_are_cut_and_say_how_much_is_left_out() -> None:
    text = as_yaml({"numbers": list(range(50_000)), "text": "x" * 5_000_000, "bytes": b"x" * 1001})
    found = yaml.safe_load(text)

    assert found["numbers"] == [*range(128), "... and 49872 more"]
    assert found["text"] == "x" * 1000 + "... and 4999000 more characters"
    assert found["bytes"].endswith("eA==... and 1 more bytes")


def test_large_maps_are_cut_and_say_how_much_is_left_out() -> None:
    found = yaml.safe_load(as_yaml({f"f{number}": 1 for number in range(1000)}))

    assert list(found) == [*(f"f{number}" for number in range(128)), "..."]
    assert found["..."] == "and 872 more"


@pytest.mark.parametrize("full", [False, True])
def test_the_number_of_all_values_is_limited(full: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(yaml_text, "MAX_VALUES_IN_FULL" if full else "MAX_VALUES", 50)
    value = [[{"a": [1, 2, 3]}] * 100] * 100

    lines = as_yaml(value, full=full).splitlines()

    assert len(lines) < 60
    assert lines[-1] == "- '... and 99 more'"


def test_in_full_nothing_is_cut() -> None:
    value = {"numbers": list(range(1000)), "text": "x" * 5000, "bytes": b"x" * 5000}

    assert yaml.safe_load(as_yaml(value, full=True)) == value


def test_a_value_that_is_too_deep_ends_at_some_level() -> None:
    value: list[Any] = []
    for _ in range(500):
        value = [value]

    assert as_yaml(value).endswith("- '... deeper than 50 levels'")

"""The live line: how far a goal has come, and what fits on a line."""

from __future__ import annotations

import io
from contextlib import redirect_stderr
from typing import Any

import pytest
from rich.console import Console

from fibaction.cli.output.lines import note
from fibaction.cli.output.progress import (
    LiveLine,
    on_one_line,
    percent_bar,
    text_beside_bar,
)
from fibaction.words.progress import Progress


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

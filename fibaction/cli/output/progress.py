"""The feedback of a goal on one line of a terminal, with a bar if the feedback has a number for the
progress of the goal.
"""

from __future__ import annotations

import sys
from itertools import islice
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.spinner import Spinner
from rich.table import Table
from rich.text import Text

from fibaction._runtime.plain_data import is_list, is_map
from fibaction.cli.output.escape import clean

PERCENT = ("percent", "percentage", "percent_complete", "percentage_complete", "percent_done")
FRACTION = ("fraction", "fraction_complete", "fraction_done", "ratio", "completion", "progress")
"""Names of fields for the progress of a goal, from 0 to 100 and from 0 to 1. A field of the second
kind counts to 100 as soon as it is larger than 1, since `progress` is used both ways."""

BAR_SHARE = 4
"""Width of the terminal, in widths of the bar."""
MOST_CHARACTERS = 500
"""Characters of a text that are shown: more than a terminal is wide."""
MOST_ITEMS = 8
"""Items of a list that are shown: its last ones, because many lists of feedback grow."""
MOST_VALUES = 200
"""Values that are shown, those within others included."""
MOST_LEVELS = 20
"""Levels of nesting that are shown."""

_WORDS = {None: "null", False: "false", True: "true"}


class Meter:
    """Finds the progress of a goal in its feedback."""

    def __init__(self) -> None:
        self.field = ""
        """The field of the last feedback that has told it; empty if none has."""
        self._of_hundred = False

    def read(self, feedback: Any) -> float | None:
        """Return the progress, from 0 to 1; None if the feedback does not tell."""
        self.field = ""
        if not is_map(feedback):
            return None
        for name, value in feedback.items():
            if isinstance(value, bool) or not isinstance(value, int | float):
                continue
            if name in PERCENT:
                self.field = name
                return _within(value / 100)
            if name in FRACTION:
                self.field = name
                self._of_hundred = self._of_hundred or value > 1
                return _within(value / 100 if self._of_hundred else value)
        return None


def _within(fraction: float) -> float | None:
    return min(max(fraction, 0.0), 1.0) if fraction == fraction else None  # NaN is not itself


class LiveLine:
    """One line on a terminal, until the end of the block."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._meter = Meter()
        self._spinner = Spinner("line")
        self._latest: tuple[int, Any] | None = None
        self._done: float | None = None
        # It draws the latest feedback ten times a second, from a thread of its own.
        self._live = Live(
            console=console,
            transient=True,
            refresh_per_second=10,
            get_renderable=self._line,
            redirect_stderr=sys.stderr.isatty(),  # output to a file does not disturb the line
        )

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._live.stop()

    def show(self, number: int, feedback: Any) -> None:
        """Show a feedback in place of the one before."""
        done = self._meter.read(feedback)
        if done is not None:  # the bar shows it
            feedback = {name: feedback[name] for name in feedback if name != self._meter.field}
        self._latest, self._done = (number, feedback), done

    def _line(self) -> Table:
        line = Table.grid(padding=(0, 2, 0, 0), expand=True)
        # A terminal prints ^C at Ctrl-C. If that began another line, this one could not be erased.
        line.width = self._console.width - len("^C^C")
        line.add_column(no_wrap=True)
        line.add_column(no_wrap=True)
        line.add_column(no_wrap=True, overflow="ellipsis", ratio=1)
        if self._latest is None:
            line.add_row(self._spinner, Text("waiting for feedback"), "")
            return line
        number, feedback = self._latest
        text = Text(on_one_line(feedback))
        if self._done is None:
            line.add_row(self._spinner, Text(f"feedback {number}"), text)
        else:
            width = self._console.width // BAR_SHARE
            bar = ProgressBar(1.0, self._done, width=width, complete_style="green")
            line.add_row(bar, Text(f"{self._done:4.0%}"), text)
        return line


def on_one_line(feedback: Any) -> str:
    """Return a feedback on one line; large feedback is cut."""
    return _OneLine().text(feedback)


class _OneLine:
    """The text of one feedback. It counts the values that it shows."""

    def __init__(self) -> None:
        self._left = MOST_VALUES

    def text(self, value: Any, level: int = 0) -> str:
        if is_map(value):
            shown = list(islice(value, max(self._left, 0)))
            cut = ["..."] if len(shown) < len(value) else []
            fields = [f"{_scalar(name)}: {self._part(value[name], level)}" for name in shown]
            return "  ".join([*fields, *cut])
        return self._part(value, level - 1)

    def _part(self, value: Any, level: int) -> str:
        self._left -= 1
        if not (is_map(value) or is_list(value)):
            return _scalar(value)
        if level > MOST_LEVELS or self._left < 0:
            return "..."
        if is_map(value):
            return f"{{{self.text(value, level + 1)}}}"
        last = islice(reversed(value), MOST_ITEMS) if isinstance(value, list | tuple) else value
        items = [self._part(item, level + 1) for item in reversed(list(islice(last, MOST_ITEMS)))]
        return f"[{'..., ' if len(value) > MOST_ITEMS else ''}{', '.join(items)}]"


def _scalar(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return _WORDS[value]
    if isinstance(value, float):
        return f"{value:.6g}"
    text = value if isinstance(value, str | bytes) else str(value)
    return clean(str(text[:MOST_CHARACTERS])[:MOST_CHARACTERS])

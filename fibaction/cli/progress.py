"""The feedback of a goal on a terminal: one line that changes, with a bar if the feedback has a
number that says how far the goal has come.
"""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.spinner import Spinner
from rich.table import Table
from rich.text import Text

from fibaction._plain_data import is_list, is_map
from fibaction.cli.escaping import clean

PERCENT = ("percent", "percentage", "percent_complete", "percentage_complete", "percent_done")
FRACTION = ("fraction", "fraction_complete", "fraction_done", "ratio", "completion", "progress")
"""Fields that tell how far a goal has come: of 100, and of 1. Those of 1 are of 100 as soon as one
is larger, since people count `progress` both ways."""

BAR_SHARE = 4
"""How many times as wide as its bar a terminal is."""
MOST_CHARACTERS = 500
"""Of a text: more than a terminal is wide."""
MOST_ITEMS = 8
"""Of a list: its last ones, because many lists of feedback grow."""

_WORDS = {None: "null", False: "false", True: "true"}


class Meter:
    """Finds out how far a goal has come, from one feedback after the other."""

    def __init__(self) -> None:
        self.field = ""
        """The field that has told it last; empty if none has."""
        self._of_hundred = False

    def read(self, feedback: Any) -> float | None:
        """How far, from 0 to 1; None if the feedback does not tell."""
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
    """One line on a terminal, which is there until the end of the block."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._meter = Meter()
        self._spinner = Spinner("line")
        self._latest: tuple[int, Any] | None = None
        self._done: float | None = None
        # It draws from a thread of its own, ten times a second, whatever is then the latest.
        self._live = Live(
            console=console,
            transient=True,
            refresh_per_second=10,
            get_renderable=self._line,
            redirect_stderr=sys.stderr.isatty(),  # what goes to a file is in nobody's way
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
        """Show a feedback instead of the one before."""
        done = self._meter.read(feedback)
        if done is not None:  # the bar says it
            feedback = {name: feedback[name] for name in feedback if name != self._meter.field}
        self._latest, self._done = (number, feedback), done

    def _line(self) -> Table:
        line = Table.grid(padding=(0, 2, 0, 0), expand=True)
        # What a terminal shows of a Ctrl-C must not begin another line: this one is to be erased.
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
    """A feedback on one line, which is not all of it if it is large."""
    if is_map(feedback):
        return "  ".join(f"{clean(str(name))}: {_brief(feedback[name])}" for name in feedback)
    return _brief(feedback)


def _brief(value: Any) -> str:
    if is_map(value):
        return f"{{{on_one_line(value)}}}"
    if is_list(value):
        items = list(value)
        shown = ", ".join(_brief(item) for item in items[-MOST_ITEMS:])
        return f"[{'..., ' if len(items) > MOST_ITEMS else ''}{shown}]"
    if value is None or isinstance(value, bool):
        return _WORDS[value]
    if isinstance(value, float):
        return f"{value:.6g}"
    return clean(str(value)[:MOST_CHARACTERS])

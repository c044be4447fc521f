"""Feedback in a terminal, with a bar if it has a number for the progress of its goal: on one live
line, or as lines.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import islice
from typing import Any, Self

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.spinner import Spinner
from rich.table import Table
from rich.text import Text

from fibaction.cli.output.escape import clean
from fibaction.cli.output.lines import console
from fibaction.words.plain_data import is_list, is_map
from fibaction.words.progress import Progress, ProgressMeter

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


class LiveLine:
    """One line on a terminal, until the end of the block."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._meter = ProgressMeter()
        self._spinner = Spinner("line")
        self._latest: tuple[int, str] | None = None
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

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def show(self, number: int, feedback: Any) -> None:
        """Show a feedback in place of the one before."""
        progress, fields = self._meter.read(feedback), self._meter.fields
        done = None if progress is None else progress.fraction
        text = on_one_line(feedback)
        if progress is not None and done is not None:  # the bar shows it
            text = text_beside_bar(feedback, progress, fields)
        self._latest, self._done = (number, text), done

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
        number, text = self._latest
        if self._done is None:
            line.add_row(self._spinner, Text(f"feedback {number}"), Text(text))
        else:
            width = self._console.width // BAR_SHARE
            bar = ProgressBar(1.0, self._done, width=width, complete_style="green")
            line.add_row(bar, Text(f"{self._done:4.0%}"), Text(text))
        return line


def text_beside_bar(feedback: dict[Any, Any], progress: Progress, fields: Sequence[str]) -> str:
    """Return a feedback on one line, without the `fields` that are shown as its progress.

    Counts stay, since a bar does not show them.
    """
    if len(fields) > 1:
        counts = clean(progress.label)
        fields = [*fields, "text"]
    else:
        counts = ""
    rest = on_one_line({name: feedback[name] for name in feedback if name not in fields})
    return "  ".join(filter(None, (counts, rest)))


def say_with_bar(head: str, fraction: float, text: str) -> None:
    """Print a head with a bar next to it, and lines of text below, to stdout, at once."""
    screen = console()
    bar = percent_bar(fraction, screen.width // BAR_SHARE)
    screen.print(Text.assemble(head, "  ", bar, f"\n{text}\n"), soft_wrap=True)


def percent_bar(fraction: float, width: int) -> Text:
    """Return a bar of a width and its percent; without a width, the percent only."""
    halves = round(fraction * width * 2)
    full = "━" * (halves // 2) + "╸" * (halves % 2)
    rest = "─" * (width - len(full))
    return Text.assemble(
        (full, "green"), (rest, "bright_black"), f"{fraction:5.0%}" if width else f"{fraction:4.0%}"
    )


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

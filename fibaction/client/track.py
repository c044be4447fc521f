"""`track`: the progress of a goal on one line at its client, until the result is there.

What the line shows is decided in `ProgressLine`, which the `track` of `fibaction.blocking` has too.
"""

from __future__ import annotations

import sys
from contextlib import closing
from importlib import import_module
from typing import Any, Protocol, TextIO, TypeVar

from fibaction._runtime.text import printable
from fibaction.client.feedback_reader import FeedbackReader
from fibaction.words.progress import Progress, ProgressMeter

ResultT = TypeVar("ResultT", covariant=True)


class _Tracked(Protocol[ResultT]):
    """A goal whose result is read only: one of `str` serves as one of `object`, as in
    `print(await track(goal))`.
    """

    @property
    def feedback(self) -> FeedbackReader[Any]:
        """The feedback."""
        ...

    async def result(self) -> ResultT:
        """Return the result."""
        ...


class _Bar(Protocol):
    """A line that shows the progress."""

    def show(self, progress: Progress | None, number: int) -> None:
        """Show the progress; None for feedback of this number that does not tell any."""

    def fill(self) -> None:
        """Show that all is done."""

    def close(self) -> None:
        """Leave the line as it is."""


async def track(goal: _Tracked[ResultT], text: str = "", *, file: TextIO | None = None) -> ResultT:
    """Read the feedback of a goal, show its progress on one line, and return its result.

    For example:

        async with client.send_goal(files) as goal:
            copied = await track(goal, "copying")

    The bar is that of tqdm, which knows notebooks, or of rich, if one of them is installed: see the
    extra `progress`. Otherwise lines of text tell the progress in steps of ten percent. Feedback
    that is not a `Progress`, and has no fields for it, is counted. `text` stands in front of the
    bar, unless the feedback has a text of its own. The line goes to `file`, by default to stderr.

    If the goal succeeds, the bar ends full. Otherwise it stays where it is.

    Raises:
        GoalAborted, GoalCanceled, GoalTimeout, UnknownGoal: As for `ClientGoal.result`.
        TransportError, ProtocolError: As for `ClientGoal.result`.
    """
    with closing(ProgressLine(text, file)) as line:
        async for feedback in goal.feedback:
            line.show(feedback, goal.feedback.number)
        result = await goal.result()
        line.fill()
    return result


class ProgressLine:
    """The progress of one goal on a line, until it is closed."""

    def __init__(self, text: str, file: TextIO | None) -> None:
        self._meter = ProgressMeter()
        self._bar = _bar(text, sys.stderr if file is None else file)

    def show(self, feedback: object, number: int) -> None:
        """Show the progress that a feedback tells, or else its number."""
        self._bar.show(self._meter.read(feedback), number)

    def fill(self) -> None:
        """Show that the goal has succeeded."""
        self._bar.fill()

    def close(self) -> None:
        """Leave the line as it is."""
        self._bar.close()


def _bar(text: str, file: TextIO) -> _Bar:
    for make in (_TqdmBar, _RichBar):
        try:
            return make(text, file)
        except ImportError:
            continue
    return _TextLines(text, file)


class _TqdmBar:
    """The bar of tqdm."""

    def __init__(self, text: str, file: TextIO) -> None:
        tqdm: Any = import_module("tqdm.auto").tqdm
        self._text = text
        self._bar = tqdm(desc=text or None, file=file)

    def show(self, progress: Progress | None, number: int) -> None:
        bar = self._bar
        bar.n = number if progress is None else _whole(progress.done)
        bar.total = None if progress is None else _whole(progress.total)
        text = self._text if progress is None else printable(progress.text) or self._text
        bar.set_description_str(text, refresh=False)
        bar.refresh()

    def fill(self) -> None:
        bar = self._bar
        if bar.total is not None:
            bar.n = bar.total
            bar.refresh()

    def close(self) -> None:
        self._bar.close()


class _RichBar:
    """The bar of rich."""

    def __init__(self, text: str, file: TextIO) -> None:
        console: Any = import_module("rich.console").Console(file=file)
        self._progress: Any = import_module("rich.progress").Progress(console=console)
        self._text = text
        self._task = self._progress.add_task(_unmarked(text), total=None)
        self._progress.start()

    def show(self, progress: Progress | None, number: int) -> None:
        progress = progress or Progress(number)
        text = _unmarked(printable(progress.text) or self._text)
        self._progress.update(
            self._task, completed=progress.done, total=progress.total, description=text
        )

    def fill(self) -> None:
        (task,) = self._progress.tasks
        total = task.completed or 1 if task.total is None else task.total
        self._progress.update(self._task, completed=total, total=total)

    def close(self) -> None:
        self._progress.stop()


class _TextLines:
    """Lines of text, one for each ten percent and for each new text."""

    def __init__(self, text: str, file: TextIO) -> None:
        self._text = text
        self._file = file
        self._line = ""
        self._latest: Progress | None = None

    def show(self, progress: Progress | None, number: int) -> None:
        self._latest = progress
        if progress is None:
            line = f"{self._text} feedback {number}"
        else:
            text, fraction = printable(progress.text) or self._text, progress.fraction
            line = text if fraction is None else f"{text} {int(fraction * 10) * 10} %"
        if line != self._line:
            self._line = line
            print(line.strip(), file=self._file, flush=True)

    def fill(self) -> None:
        latest = self._latest
        if latest is not None and latest.fraction is not None:
            self.show(Progress(1, 1, latest.text), 0)

    def close(self) -> None:
        """Do nothing: each line is whole."""


def _whole(value: float | None) -> float | None:
    """Return a number without its fraction if that is 0: `3`, not `3.0`."""
    return int(value) if value is not None and float(value).is_integer() else value


def _unmarked(text: str) -> str:
    """Return a text in which rich finds no markup."""
    return text.replace("[", "\\[")

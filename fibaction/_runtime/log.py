"""Loggers that write nothing of a peer's text as it was sent, and no flood of lines.

Theory of operation
-------------------

Text of peers reaches the log in many ways: in reasons, in errors of foreign code that quote it, in
tracebacks. So it is not the calls of a logger that make it safe, but a filter on every logger of
fibaction, before any handler of the program's gets the record:

- The message is one printable line of at most `MESSAGE` characters. An argument of it that is text,
  or an error, is cut to `ARGUMENT` characters; so one long argument does not hide the others.
- A traceback keeps its lines. Each is printable, has at most `LINE` characters and is indented, so
  that it does not look like a record of its own; there are at most `LINES` of them. The text is put
  where formatters keep the text of a traceback (`LogRecord.exc_text`), and they write that one.

A record keeps its error (`exc_info`) for tools that want more than text, and its message and its
arguments apart if they are clean, so that tools can still group records by message. An argument
that is an error becomes text, because the error may keep a whole payload alive.

A filter is called for the records of enabled levels only, once for each record. It must not raise,
whatever an error's own `__str__` does: that would end in the code that logs.

The same filter leaves out lines of a flood (`LineLimit`). Lines are of one kind if one call of a
logger has made them, with the same level and, if it says one, the same `kind` (in `extra`). The
first `QUOTA` lines of each kind in an interval are written, and the others are counted. Their
number is a line of its own, written with the next line of any kind after the interval, or at the
end of the process; no task or thread waits for it. While a flood lasts, its next intervals have
that line only. The table of kinds is bounded (`MOST_KINDS`).
"""

from __future__ import annotations

import atexit
import logging
import traceback
from collections.abc import Callable, Iterator
from itertools import islice
from threading import RLock
from time import monotonic
from typing import Any, TypeAlias, cast

from fibaction._runtime.text import REASON, excerpt, shortened

ARGUMENT = 400
"""Characters of one argument of a message."""
MESSAGE = 2000
"""Characters of a message."""
LINE = 300
"""Characters of one line of a traceback, without the indent."""
LINES = 200
"""Lines of a traceback, with the causes of the error."""
FRAMES = 20
"""Frames of one error: the innermost ones."""
ERRORS = 10
"""Errors of one chain, or of one group."""
DEPTH = 5
"""Groups in groups."""

INTERVAL = 10.0
"""Seconds in which lines of one kind are counted."""
LOOK_AGAIN = 0.1
"""Seconds after which a line looks again whether intervals are over."""
MOST_KINDS = 1000
"""Kinds that are told apart; beyond them, those of one call are one kind."""
QUOTA = 20
"""Lines of one kind that are written in one interval."""

INDENT = "  "

_CAUSE = "The above exception was the direct cause of the following exception:"
_CONTEXT = "During handling of the above exception, another exception occurred:"

# For these, Python looks for the name that was meant, or has a line of code to show.
_EXPLAINED = (AttributeError, ImportError, NameError, SyntaxError)


def clean_logger(name: str) -> logging.Logger:
    """Return the logger of that name, whose records are clean, and not too many of one kind."""
    logger = logging.getLogger(name)
    logger.addFilter(_filter)
    return logger


Kind: TypeAlias = tuple[str, int, str, int, object]
"""The logger, the level, the call in the code, and what the call says about it."""
Count: TypeAlias = tuple[Kind, int, float, str]
"""The lines of a kind that were left out, in how many seconds, and the first of them."""


class _Written:
    """The lines of one kind in one interval."""

    __slots__ = ("began", "example", "left", "left_out")

    def __init__(self, began: float, left: int) -> None:
        self.began = began
        self.left = left
        """Lines that are still to be written."""
        self.left_out = 0
        """Lines that were not written."""
        self.example = ""
        """The first line that was not written."""


class LineLimit:
    """A limit for the lines of each kind in an interval."""

    def __init__(self, clock: Callable[[], float] = monotonic) -> None:
        """Take the time from this clock, in seconds."""
        self._clock = clock
        self._kinds: dict[Kind, _Written] = {}
        self._look_at = 0.0  # the time at which intervals may be over
        self._lock = RLock()  # any thread may log, and so may the text of an argument

    def passes(self, record: logging.LogRecord) -> bool:
        """Return whether a record is to be written. Counts whose interval is over are written
        first.
        """
        kind = _kind_of(record)
        now = self._clock()
        with self._lock:
            counts = self._end_intervals(now) if now >= self._look_at else []
            if len(self._kinds) >= MOST_KINDS and kind not in self._kinds:
                kind = (*kind[:-1], None)
            lines = self._kinds.setdefault(kind, _Written(now, QUOTA))
            is_written = lines.left > 0
            if is_written:
                lines.left -= 1
            else:
                lines.left_out += 1
                lines.example = lines.example or _message_of(record)
        for count in counts:
            _write(count)
        return is_written

    def _end_intervals(self, now: float) -> list[Count]:
        """Begin a new interval for kinds whose interval is over; return what was left out."""
        self._look_at = now + LOOK_AGAIN
        counts: list[Count] = []
        for kind, lines in tuple(self._kinds.items()):
            if now - lines.began < INTERVAL:
                continue
            if lines.left_out:
                counts.append((kind, lines.left_out, now - lines.began, lines.example))
                self._kinds[kind] = _Written(now, 0)  # the flood may last
            else:
                del self._kinds[kind]
        return counts

    def flush(self) -> None:
        """Write all counts, and forget all lines: the process ends."""
        with self._lock:
            kinds, self._kinds = self._kinds, {}
        now = self._clock()
        for kind, lines in kinds.items():
            if lines.left_out:
                _write((kind, lines.left_out, now - lines.began, lines.example))


LIMIT = LineLimit()
"""The limit of this process."""
atexit.register(LIMIT.flush)


def _kind_of(record: logging.LogRecord) -> Kind:
    says = getattr(record, "kind", None)
    return record.name, record.levelno, record.pathname, record.lineno, says


def _write(count: Count) -> None:
    """Write the number of lines of a kind that were left out."""
    (name, level, path, line, _), number, seconds, example = count
    logger = logging.getLogger(name)
    text = "%d more lines like this one in %.0f s: %s"
    record = logger.makeRecord(name, level, path, line, text, (number, seconds, example), None)
    _clean(record)
    logger.callHandlers(record)


def _filter(record: logging.LogRecord) -> bool:
    """Return whether a record is to be written, and clean it."""
    if not LIMIT.passes(record):
        return False
    _clean(record)
    return True


def _message_of(record: logging.LogRecord) -> str:
    try:
        return record.getMessage()
    except Exception:  # an argument that has no text, or that does not fit the message
        return str(record.msg)


def _clean(record: logging.LogRecord) -> None:
    """Clean a record."""
    if isinstance(record.args, tuple):
        record.args = tuple(map(_argument, record.args))
    try:
        text = record.getMessage()
    except Exception:  # an argument that has no text, or that does not fit the message
        text = f"{record.msg} (its arguments cannot be shown)"
        record.msg, record.args = text, ()
    if len(text) > MESSAGE or not text.isprintable():
        record.msg, record.args = excerpt(text, MESSAGE), ()
    if record.exc_info and record.exc_info[1] is not None:
        record.exc_text = traceback_text(record.exc_info[1])
    if record.stack_info:
        record.stack_info = _indented(record.stack_info.split("\n"))


def _argument(value: Any) -> Any:
    """Return an argument of a message, cut if it is text; an error becomes text."""
    if isinstance(value, BaseException):
        value = _text(value)
    return shortened(value, ARGUMENT) if isinstance(value, str) else value


# Tracebacks


def traceback_text(exc: BaseException) -> str:
    """Return the traceback of an error, and of the errors behind it, as indented lines."""
    try:
        return _indented(_with_causes(exc, 0))
    except Exception as bad:  # the error is of a class with methods of its own
        return f"{INDENT}(no traceback of a {type(exc).__name__}: {type(bad).__name__})"


def _indented(lines: list[str]) -> str:
    return "\n".join(INDENT + excerpt(line, LINE) for line in lines[:LINES])


def _with_causes(exc: BaseException, depth: int) -> list[str]:
    """Return the lines of an error and of those that led to it, which come first."""
    room = LINES - 1
    blocks: list[list[str]] = []
    for error, link in _chain(exc):
        # The error itself is the most important one, so it takes its lines first.
        blocks.append([*islice(_lines(error, depth), room), *link])
        room -= len(blocks[-1])
        if room <= 0:
            blocks.append(["... (some lines are left out)"])
            break
    return [line for block in reversed(blocks) for line in block]


def _chain(exc: BaseException) -> Iterator[tuple[BaseException, list[str]]]:
    """Yield the error and those that led to it, each with the words that lead to the next."""
    link: list[str] = []
    error: BaseException | None = exc
    for _ in range(ERRORS):
        if error is None:
            return
        yield error, link
        if error.__cause__ is not None:
            error, link = error.__cause__, ["", _CAUSE, ""]
        else:
            error = None if error.__suppress_context__ else error.__context__
            link = ["", _CONTEXT, ""]


def _lines(exc: BaseException, depth: int) -> Iterator[str]:
    """Yield the lines of one error."""
    if exc.__traceback__ is not None:
        yield "Traceback (most recent call last):"
        frames = traceback.walk_tb(exc.__traceback__)
        for frame in traceback.StackSummary.extract(frames, limit=-FRAMES).format():
            yield from frame.rstrip("\n").split("\n")
    if isinstance(exc, _EXPLAINED):
        text = "".join(traceback.format_exception_only(exc)).rstrip("\n")
    else:
        kind = type(exc)
        place = "" if kind.__module__ in ("builtins", "__main__") else f"{kind.__module__}."
        text = _text(exc)
        text = f"{place}{kind.__qualname__}" + (f": {text}" if text else "")
        for note in getattr(exc, "__notes__", ())[:ERRORS]:
            text = f"{shortened(text)}\n{shortened(str(note))}"
    yield from shortened(text, LINES * LINE).split("\n")
    if isinstance(exc, BaseExceptionGroup) and depth < DEPTH:
        parts = cast("BaseExceptionGroup[BaseException]", exc).exceptions
        for number, part in enumerate(parts[:ERRORS], 1):
            yield f"+---- {number} of {len(parts)} ----"
            yield from ("| " + line for line in _with_causes(part, depth + 1))


def _text(exc: BaseException) -> str:
    """Return the text of an error, cut."""
    try:
        return shortened(str(exc), REASON)
    except (Exception, SystemExit):
        return f"(no text of a {type(exc).__name__})"

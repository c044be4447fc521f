"""Loggers that write nothing of a peer's text as it was sent.

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
"""

from __future__ import annotations

import logging
import traceback
from collections.abc import Iterator
from itertools import islice
from typing import Any, cast

from fibaction._runtime.text import REASON, excerpt, shortened

ARGUMENT = 400
"""Characters of one argument of a message."""
MESSAGE = 2000
"""Characters of a message."""
LINE = 300
"""Characters of one line of a traceback, without the indent."""
LINES = 200
"""Lines of a traceback, with all errors behind the error."""
FRAMES = 20
"""Frames of one error: the innermost ones."""
ERRORS = 10
"""Errors of one chain, or of one group."""
DEPTH = 5
"""Groups in groups."""

INDENT = "  "

_CAUSE = "The above exception was the direct cause of the following exception:"
_CONTEXT = "During handling of the above exception, another exception occurred:"

# For these, Python looks for the name that was meant, or has a line of code to show.
_EXPLAINED = (AttributeError, ImportError, NameError, SyntaxError)


def clean_logger(name: str) -> logging.Logger:
    """Return the logger of that name, whose records are clean."""
    logger = logging.getLogger(name)
    logger.addFilter(_clean)
    return logger


def _clean(record: logging.LogRecord) -> bool:
    """Clean a record; return True, since every record passes."""
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
    return True


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
    except Exception:
        return f"(no text of a {type(exc).__name__})"

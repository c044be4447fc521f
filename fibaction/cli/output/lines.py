"""Output of the command line: lines, remarks, JSON, the console, and the log on stderr."""

from __future__ import annotations

import csv
import io
import logging
import sys
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO

import click

from fibaction._runtime.log import traceback_text
from fibaction.cli.output.escape import clean, clean_json
from fibaction.cli.process.exit_codes import ExitCode, Failure
from fibaction.observe.log_records import GoalFilter, JsonFormatter

if TYPE_CHECKING:
    from rich.console import Console


def say(text: str = "") -> None:
    """Print a line, or several, to stdout, at once."""
    click.echo(text)


def note(text: str) -> None:
    """Print a remark on one line of stderr. Text of a server in it cannot control the terminal."""
    # click would bypass the stream that rich puts here to protect a live line.
    sys.stderr.write(f"{clean(text)}\n")
    sys.stderr.flush()


class LogHandler(logging.StreamHandler[TextIO]):
    """A handler that writes the log where `note` writes."""

    def emit(self, record: logging.LogRecord) -> None:
        self.stream = sys.stderr  # rich may have replaced it since
        super().emit(record)


def say_json(value: Any) -> None:
    """Print a value as one line of JSON."""
    click.echo(as_json(value))


def say_csv(rows: Iterable[Iterable[str]]) -> None:
    """Print rows of CSV. The cells are printable, so each row is one line."""
    lines = io.StringIO()
    csv.writer(lines, lineterminator="\n").writerows(rows)
    click.echo(lines.getvalue(), nl=False)


def console() -> Console:
    """Return a rich console on stdout, with colours on a terminal only, and without `NO_COLOR`."""
    from rich.console import Console

    # Text of others is printed as it is: no coloured numbers or paths, no `[tags]`.
    return Console(highlight=False, markup=False, emoji=False)


def on_terminal() -> bool:
    """Return whether stdout is a terminal on which a line can be redrawn."""
    found = console()
    return found.is_terminal and not found.is_dumb_terminal


def as_json(value: Any) -> str:
    """Return the value as one line of JSON that cannot control a terminal.

    Raises:
        Failure: JSON cannot express it.
    """
    from fibaction.schema.payload import PayloadError, to_json  # its imports would slow down --help

    try:
        return clean_json(to_json(value))
    except PayloadError as exc:
        raise Failure(str(exc), ExitCode.ABORTED) from exc


class CleanFormatter(logging.Formatter):
    """Writes each record of fibaction, and of its extensions, on one clean line, since it may
    contain text of a peer.

    Records of the user's own code are not changed. A traceback keeps its lines and is cleaned,
    whichever code logs it: an executor's exception may contain what a client has sent.
    """

    def formatMessage(self, record: logging.LogRecord) -> str:
        text = super().formatMessage(record)
        return clean(text) if record.name.startswith("fibaction") else text

    def formatException(self, ei: Any) -> str:
        return traceback_text(ei[1])


@contextmanager
def log_with_time(*, as_json: bool = False) -> Generator[None, None, None]:
    """Log to stderr with the time during the block; warnings, and with `log_events` more.

    With `as_json`, each record is a JSON object on one line, with the goal that it belongs to.
    """
    root, files = logging.getLogger(), logging.getLogger("watchfiles")
    before = root.handlers[:], root.level, files.level
    handler = logging.StreamHandler()
    handler.setFormatter(CleanFormatter("%(asctime)s %(message)s"))
    if as_json:
        handler.addFilter(GoalFilter())
        handler.setFormatter(JsonFormatter())
    root.handlers[:] = [handler]
    root.setLevel(logging.WARNING)
    files.setLevel(logging.ERROR)  # its warnings repeat what the command says
    try:
        yield
    finally:
        root.handlers[:] = before[0]
        root.setLevel(before[1])
        files.setLevel(before[2])


def log_events() -> None:
    """Log from now on what happens, not only warnings."""
    logging.getLogger().setLevel(logging.INFO)


def log_connection() -> None:
    """Log when the connection is lost and when it is back.

    The user of a command that waits wants to know why nothing happens.
    """
    logging.getLogger("fibaction.wire").setLevel(logging.INFO)

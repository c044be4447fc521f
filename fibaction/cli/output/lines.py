"""Output of the command line: lines, remarks, JSON and the console."""

from __future__ import annotations

import csv
import io
import logging
import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, TextIO

import click

from fibaction.cli.output.escape import clean, clean_json
from fibaction.cli.process.exit_codes import ExitCode, Failure

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

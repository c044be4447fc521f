"""`fibaction store`: work on the file of a store; `backup` copies one that may be in use."""

from __future__ import annotations

import os
from datetime import datetime

import anyio
import click

from fibaction.cli.output.lines import say
from fibaction.cli.process.exit_codes import ExitCode, Failure


@click.group("store", epilog="\b\nExample:\n  fibaction store backup goals.db")
def store_command() -> None:
    """Work on the file in which a server keeps its goals."""


@store_command.command(
    "backup",
    short_help="Copy a store to a new file.",
    epilog="""\b
Examples:
  fibaction store backup goals.db
  fibaction store backup goals.db /mnt/backup/monday.db""",
)
@click.argument("file", metavar="FILE", type=click.Path())
@click.argument("target", metavar="[TARGET]", type=click.Path(), required=False)
def backup_command(file: str, target: str | None) -> None:
    """Copy the store in FILE to the new file TARGET, also while its server runs.

    TARGET has the goals of one moment, and needs no other file beside it. Without it, the copy is
    beside FILE, with the time in its name.
    """
    from fibaction.stores._copy import back_up  # sqlite3 would slow down --help

    target = target or _dated(file)
    for name in (target, f"{target}-wal"):  # SQLite would take that for a part of the copy
        if os.path.lexists(name):
            raise Failure(f"{name} exists: name a new file", ExitCode.USAGE)
    try:
        count = anyio.run(back_up, file, target)
    except OSError as exc:
        raise Failure(f"cannot write {target}: {exc.strerror}", ExitCode.USAGE) from exc
    say(f"{target} has {count:,} {'goal' if count == 1 else 'goals'}")


def _dated(file: str) -> str:
    name, ending = os.path.splitext(file)
    return f"{name}-{datetime.now():%Y-%m-%dT%H-%M-%S}{ending}"

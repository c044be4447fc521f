"""`fibaction workers`: list the workers of a fleet."""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from urllib.parse import urlsplit

import click
import msgspec

from fibaction._api import connect
from fibaction.border.urls import without_settings
from fibaction.cli.arguments.action_names import shown
from fibaction.cli.arguments.options import json_option, url_option
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.goal_table import aligned, duration
from fibaction.cli.output.lines import note, say, say_json
from fibaction.cli.process.exit_codes import ExitCode, Failure, run
from fibaction.words.goals import WorkerInfo

FLEETS = ("nats", "nats+tls")
"""The schemes of the URLs of fleets."""


@click.command("workers", epilog="\b\nExample:\n  fibaction workers -u nats://127.0.0.1/robots")
@json_option
@url_option
def workers_command(as_json: bool, url: str) -> None:
    """List the workers of a fleet: their goals, whether they take new ones, the time since they
    joined, and their actions.
    """
    run(list_workers, url, as_json=as_json)


async def list_workers(url: str, *, as_json: bool) -> int:
    """Print the workers, one a line.

    Raises:
        Failure: The URL is not that of a fleet.
    """
    if urlsplit(url).scheme not in FLEETS:
        raise Failure(
            f"{without_settings(url)} is one server, and not a fleet with workers: give the URL of"
            f" a fleet, such as nats://127.0.0.1/robots"
        )
    async with connect(url) as connection:
        workers = await connection.workers()
    if as_json:
        for worker in workers:
            say_json(msgspec.to_builtins(worker))
    elif not workers:
        note(f"There are no workers at {without_settings(url)}.")
    else:
        for line in lines_of(workers, time.time()):
            say(line)
        note_unreadable(workers)
    return ExitCode.SUCCEEDED


def note_unreadable(workers: Sequence[WorkerInfo], actions: Collection[str] = ()) -> None:
    """Print how many goals of each action no worker can read; of some actions, if there are any."""
    for name in sorted({name for worker in workers for name in worker.unreadable}):
        serving = [worker for worker in workers if name in worker.actions]
        count = min(worker.unreadable.get(name, 0) for worker in serving)
        if count and (name in actions or not actions):
            goals = "1 waiting goal" if count == 1 else f"{count:,} waiting goals"
            note(
                f"{goals} of {shown(name)} that no worker here can read: start a worker of the"
                f" version that accepted them, or end them with unreadable='abort'"
            )


def lines_of(workers: Sequence[WorkerInfo], now: float) -> list[str]:
    """Return the workers in columns, below a line of headings."""
    heading = ["WORKER", "ROOM", "GOALS", "JOINED", "ACTIONS"]
    return aligned([heading, *(_cells(worker, now) for worker in workers)])


def _cells(worker: WorkerInfo, now: float) -> list[str]:
    return [
        excerpt(worker.name),
        "yes" if worker.has_room else "no",
        str(worker.goals),
        f"{duration(now - worker.since / 1e9)} ago",
        ", ".join(excerpt(name) for name in sorted(map(shown, worker.actions))) or "-",
    ]

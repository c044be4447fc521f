"""`fibaction record`, `replay`, `show` and `export`: recordings of goals.

The work is done by `fibaction.observe.recordings`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from datetime import datetime
from functools import partial
from typing import Any

import click

from fibaction._api import ClientConnection, connect
from fibaction.border.urls import without_settings
from fibaction.cli.arguments.import_target import AnyServer
from fibaction.cli.arguments.names import names_of, shown
from fibaction.cli.arguments.options import NumberType, reject_inproc, url_of
from fibaction.cli.output.escape import clean
from fibaction.cli.output.lines import log_connection, log_with_time, say, say_json
from fibaction.cli.process.exit_codes import ExitCode, Failure, advising, run
from fibaction.cli.process.signals import stop_signals, until_interrupted
from fibaction.cli.verbs.serve import served
from fibaction.observe.recordings.recorder import Recorder, record_from


@click.command(
    "record",
    epilog="""\b
Examples:
  fibaction record tcp://127.0.0.1:7400 today.jsonl
  fibaction record ros2:// today.jsonl""",
)
@click.argument("url", metavar="URL")
@click.argument("file", metavar="FILE", type=click.Path(dir_okay=False))
def record_command(url: str, file: str) -> None:
    """Record the goals of all actions at URL, until Ctrl-C or SIGTERM.

    No executor waits for this command. It does not see what observers are not told, for example
    rejected goals; `fibaction serve --record` records everything. The recording is appended to
    FILE.
    """
    reject_inproc(url)
    run(record, url, file)


async def record(url: str, file: str) -> int:
    """Record until a signal comes.

    Raises:
        Failure: There is no server, or the file cannot be written to.
    """
    async with connect(url) as connection:
        with advising("or give another URL"):
            await connection.actions()  # an error comes before the file is made
        log_connection()
        await until_interrupted(partial(_record, connection, url, file))
    return ExitCode.SUCCEEDED


async def _record(connection: ClientConnection, url: str, file: str) -> None:
    try:
        with Recorder(file) as recorder:
            say(f"recording {without_settings(url)} to {file}, Ctrl-C stops it")
            await record_from(connection, recorder)
    except OSError as exc:
        raise Failure(f"cannot record to {file}: {exc.strerror}") from exc


@click.command(
    "replay",
    epilog="""\b
Examples:
  fibaction replay today.jsonl
  fibaction replay today.jsonl http://127.0.0.1:8080 --speed 4""",
)
@click.argument("file", metavar="FILE", type=click.Path(exists=True, dir_okay=False))
@click.argument("urls", metavar="[URL]...", nargs=-1)
@click.option(
    "--speed",
    type=NumberType(),
    default=1.0,
    help="2 is twice as fast as in the recording.",
)
@click.pass_context
def replay_command(context: click.Context, file: str, urls: tuple[str, ...], speed: float) -> None:
    """Answer goals from a recording, without a robot.

    A goal that is equal to a recorded one gets its feedback at the recorded times, and its end.
    Other goals are rejected. Ctrl-C or SIGTERM stops it.
    """
    from fibaction.observe.recordings.replay import RecordingError, replayed

    where = urls or (url_of(context),)
    reject_inproc(*where)
    try:
        servers = replayed(file, speed=speed)
    except RecordingError as exc:
        raise Failure(str(exc)) from exc
    with log_with_time():
        run(replay, servers, where, file, uvloop=True)


async def replay(servers: Sequence[AnyServer], urls: Sequence[str], file: str) -> int:
    """Serve recorded goals until a signal comes."""
    async with stop_signals() as stop, served(servers, *urls) as where:
        say(f"replaying {names_of(servers)} of {file} at {', '.join(where)}, Ctrl-C stops it")
        await stop.wait()
    return ExitCode.SUCCEEDED


SECOND = 1_000_000_000


class Summary:
    """The numbers of one action in a recording."""

    def __init__(self) -> None:
        self.active: set[str] = set()
        self.ends: Counter[str] = Counter()
        self.feedback = 0

    @property
    def goals(self) -> int:
        """The number of its goals."""
        return self.ends.total() + len(self.active)

    def __str__(self) -> str:
        ends = [f"{count} {status}" for status, count in self.ends.most_common()]
        if self.active:
            ends.append(f"{len(self.active)} without an end")
        messages = "feedback message" if self.feedback == 1 else "feedback messages"
        return f"{', '.join(ends) or 'no goals'}; {self.feedback:,} {messages}"

    def json(self) -> dict[str, Any]:
        """Return the numbers as JSON data."""
        return {"ends": self.ends, "active": len(self.active), "feedback": self.feedback}


@click.command("show", epilog="\b\nExample:\n  fibaction show today.jsonl")
@click.argument("file", metavar="FILE", type=click.Path(exists=True, dir_okay=False))
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def show_command(file: str, as_json: bool) -> None:
    """Summarise a recording of `fibaction serve --record`."""
    from fibaction.observe.recordings.recording_file import read_records

    first = last = dropped = 0
    actions: dict[str, Summary] = {}
    for record in read_records(file):
        first, last = first or record.time, record.time
        if record.event == "dropped":
            dropped += record.number
            continue
        found = actions.setdefault(record.action, Summary())
        if record.event == "feedback":
            found.feedback += 1
        elif record.event == "accepted":
            found.active.add(record.goal_id)
        elif record.event in ("end", "rejected"):
            found.active.discard(record.goal_id)
            found.ends[record.status or "REJECTED"] += 1
    if not actions:
        raise Failure(f"{file} is not a recording of fibaction, or is empty")
    if as_json:
        summaries = {name: found.json() for name, found in actions.items()}
        say_json({"first": first, "last": last, "dropped": dropped, "actions": summaries})
        return
    begin, end = (datetime.fromtimestamp(time // SECOND) for time in (first, last))
    same_day = begin.date() == end.date()
    until = end.strftime("%H:%M:%S") if same_day else str(end)
    goals = sum(found.goals for found in actions.values())
    say(f"{begin} to {until}, {goals} {'goal' if goals == 1 else 'goals'}")
    for name, found in actions.items():
        say(f"{clean(shown(name))}: {clean(str(found))}")
    if dropped:
        say(f"feedback messages that are missing: {dropped:,}")


@click.command("export", epilog="\b\nExample:\n  fibaction export today.jsonl today.mcap")
@click.argument("recording", metavar="FILE", type=click.Path(exists=True, dir_okay=False))
@click.argument("path", metavar="MCAP_FILE", type=click.Path(dir_okay=False))
def export_command(recording: str, path: str) -> None:
    """Write a recording as an MCAP file, which Foxglove opens. MCAP_FILE is replaced."""
    from fibaction.observe.recordings.recording_file import RecordingError, export_mcap

    try:
        count = export_mcap(recording, path)
    except (ImportError, RecordingError) as exc:
        raise Failure(str(exc)) from exc
    except OSError as exc:
        raise Failure(f"cannot write {path}: {exc.strerror}") from exc
    say(f"{path} has {count:,} messages")

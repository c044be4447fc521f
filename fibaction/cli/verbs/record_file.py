"""`fibaction record`: record a server from outside, by
`fibaction.observe.recordings.remote_recorder`.
"""

from __future__ import annotations

from functools import partial

import click

from fibaction._api import ClientConnection, connect
from fibaction.border.urls import without_settings
from fibaction.cli.arguments.options import reject_inproc
from fibaction.cli.output.lines import say
from fibaction.cli.process.exit_codes import ExitCode, Failure, advising, run
from fibaction.cli.process.logs import log_connection
from fibaction.cli.process.signals import until_interrupted
from fibaction.observe.recordings.recorder import Recorder
from fibaction.observe.recordings.remote_recorder import record_from


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

    The command is an observer, for which no executor waits. It misses what observers are not told,
    for example rejected goals; `fibaction serve --record` misses nothing. FILE is appended to.
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
        raise Failure(f"cannot record to {file}: {exc.strerror}", ExitCode.USAGE) from exc

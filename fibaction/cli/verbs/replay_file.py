"""`fibaction replay`: serve the goals of a recording, by `fibaction.replay`."""

from __future__ import annotations

from collections.abc import Sequence

import click

from fibaction.cli.arguments.action_names import names_of
from fibaction.cli.arguments.import_target import AnyServer
from fibaction.cli.arguments.options import reject_inproc, url_of
from fibaction.cli.output.lines import say
from fibaction.cli.process.exit_codes import ExitCode, Failure, run
from fibaction.cli.process.logs import log_with_time
from fibaction.cli.process.signals import stop_signals
from fibaction.cli.verbs.serve import served


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
    type=click.FloatRange(min=0, min_open=True),
    default=1.0,
    help="2 is twice as fast as in the recording.",
)
@click.pass_context
def replay_command(context: click.Context, file: str, urls: tuple[str, ...], speed: float) -> None:
    """Answer goals as a recording has it, without a robot.

    A goal that is equal to a recorded one gets its feedback at the recorded times, and its end.
    Other goals are rejected. Ctrl-C or SIGTERM stops it.
    """
    from fibaction.observe.recordings.replay import RecordingError, replayed

    where = urls or (url_of(context),)
    reject_inproc(*where)
    try:
        servers = replayed(file, speed=speed)
    except RecordingError as exc:
        raise Failure(str(exc), ExitCode.USAGE) from exc
    with log_with_time():
        run(replay, servers, where, file, uvloop=True)


async def replay(servers: Sequence[AnyServer], urls: Sequence[str], file: str) -> int:
    """Serve recorded goals until a signal comes."""
    async with stop_signals() as stop, served(servers, *urls) as where:
        say(f"replaying {names_of(servers)} of {file} at {', '.join(where)}, Ctrl-C stops it")
        await stop.wait()
    return ExitCode.SUCCEEDED

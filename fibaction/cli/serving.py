"""`fibaction serve`: `fibaction.serve`, of what a module of the user's has."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator, Sequence
from contextlib import asynccontextmanager

import anyio
import click

from fibaction._api import serve
from fibaction.abc import StatusStream
from fibaction.cli.app import refuse_inproc, run, url_of
from fibaction.cli.ending import ExitCode
from fibaction.cli.loading import AnyServer, load
from fibaction.cli.output import say
from fibaction.cli.running import logging_to_stderr, names_of, stop_signals
from fibaction.states import GoalStatus

logger = logging.getLogger(__name__)


@click.command(
    "serve",
    epilog="""\b
Examples:
  fibaction serve robot:server
  fibaction serve robot:make_servers tcp://127.0.0.1:7400 unix:///run/robot.sock ros2://
  fibaction serve robot:server --reload""",
)
@click.argument("target", metavar="MODULE:SERVER")
@click.argument("urls", metavar="[URL]...", nargs=-1)
@click.option("--reload", is_flag=True, help="Start again when the module's .py files change.")
@click.pass_context
def serve_command(context: click.Context, target: str, urls: tuple[str, ...], reload: bool) -> None:
    """Run the action servers of a module of yours, at one URL or at several at once.

    SERVER is an ActionServer, a list of several, or a function without arguments that gives them.
    The module is looked for in the current folder first.

    Ctrl-C or SIGTERM ends all goals, tells their clients and stops. A second one ends at once.
    """
    where = urls or (url_of(context),)
    refuse_inproc(*where)  # beside another it is of use: to the servers themselves
    with logging_to_stderr():
        if reload:
            from fibaction.cli.reloading import serve_reloading

            run(serve_reloading, target, where, uvloop=True)
        else:
            run(serve_servers, load(target), where, uvloop=True)


async def serve_servers(servers: Sequence[AnyServer], urls: Sequence[str]) -> int:
    """Serve until a signal comes, then let the goals end and tell their clients."""
    async with stop_signals() as stop, serving(servers, *urls) as where:
        say(f"serving {names_of(servers)} at {', '.join(where)}, Ctrl-C stops it")
        await stop.wait()
    return ExitCode.SUCCEEDED


@asynccontextmanager
async def serving(
    servers: Sequence[AnyServer], *urls: str
) -> AsyncGenerator[tuple[str, ...], None]:
    """`fibaction.serve`, with a line in the log for each change of a goal's status."""
    async with serve(servers, *urls) as where, anyio.create_task_group() as tasks:
        for server in servers:
            tasks.start_soon(_log_goals, server.action.name, await server.status())
        yield where
        # Ends the streams of statuses too, behind the last one, and with them the tasks above.
        for server in servers:
            tasks.start_soon(server.stop)


async def _log_goals(action: str, changes: StatusStream) -> None:
    with changes:
        while (goal := await changes.receive()) is not None:
            if goal.status is not GoalStatus.UNKNOWN:  # it was logged when it ended
                logger.info("goal %s of action %r: %s", goal.goal_id, action, goal.status.name)

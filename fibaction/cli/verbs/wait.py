"""`fibaction wait`: wait until an action is served."""

from __future__ import annotations

import math
from collections.abc import Sequence

import anyio
import click

from fibaction._api import ClientConnection, connect
from fibaction.cli.arguments.action_names import shown
from fibaction.cli.arguments.completion import ACTION
from fibaction.cli.arguments.options import NumberType, url_option
from fibaction.cli.process.exit_codes import ExitCode, Failure, run
from fibaction.words.errors import ConnectionLost, ServerNotFound

LOOK_PAUSE = 0.2
"""Seconds between two looks for the actions."""


@click.command(
    "wait",
    epilog="""\b
Examples:
  fibaction wait fibonacci && fibaction send_goal fibonacci "order: 10"
  fibaction wait arm/pick arm/place -t 30""",
)
@click.argument("names", metavar="NAME...", nargs=-1, required=True, type=ACTION)
@click.option(
    "-t",
    "--timeout",
    type=NumberType(),
    metavar="SECONDS",
    help="Give up after that time, with exit code 6.",
)
@url_option
def wait_command(names: tuple[str, ...], timeout: float | None, url: str) -> None:
    """Wait until the actions are served, and print nothing."""
    run(wait, url, names, timeout)


async def wait(url: str, names: Sequence[str], timeout: float | None) -> int:
    """Wait until all actions are served.

    Raises:
        Failure: They are not within `timeout` seconds.
        ActionError: The server cannot be asked, for another reason than that it does not run.
    """
    missing = {shown(name) for name in names}
    with anyio.move_on_after(math.inf if timeout is None else timeout):
        async with connect(url) as connection:
            while True:
                missing -= await _served(connection)
                if not missing:
                    return ExitCode.SUCCEEDED
                await anyio.sleep(LOOK_PAUSE)
    raise Failure(
        f"{', '.join(sorted(missing))}: not served within {timeout:g} s", ExitCode.UNREACHABLE
    )


async def _served(connection: ClientConnection) -> set[str]:
    try:
        return {shown(info.name) for info in await connection.actions()}
    except (ServerNotFound, ConnectionLost):
        return set()

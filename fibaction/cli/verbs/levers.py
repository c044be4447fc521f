"""`fibaction pause`, `resume` and `drain`: the levers of an operator."""

from __future__ import annotations

import getpass
import math
import socket
from collections.abc import Callable
from functools import partial, wraps
from typing import Any, NamedTuple, NoReturn

import anyio
import click
import msgspec

from fibaction._api import connect
from fibaction.cli.arguments.completion import ACTION, namespace_option
from fibaction.cli.arguments.goal_lookup import ActionClients
from fibaction.cli.arguments.names import ROOT, Namespace, shown
from fibaction.cli.arguments.options import NumberType, json_option, url_option
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.lines import note, say, say_json
from fibaction.cli.process.exit_codes import ExitCode, Failure, message_of, run
from fibaction.observe.monitor import AnyClient
from fibaction.words.errors import ActionError
from fibaction.words.goals import GoalInfo
from fibaction.words.intake import IntakeChange, IntakeMode

GOALS_PAUSE = 0.25
"""Seconds between two looks at the goals that a drain waits for."""

all_option = click.option("--all", "every", is_flag=True, help="All actions that are served.")
worker_option = click.option("--worker", metavar="NAME", default="", help="One worker of a fleet.")


class Lever(NamedTuple):
    """The words of a user that all levers have in common."""

    names: tuple[str, ...]
    reason: str
    namespace: Namespace
    as_json: bool
    url: str

    def check_names(self, *, every: bool) -> None:
        """Raise `Failure` if there are neither names nor `--all`, or both."""
        if bool(self.names) is every:
            raise Failure("name the actions, or give --all for all of them")

    def move(self, mode: IntakeMode, *, worker: str = "", wait: float = 0.0) -> NoReturn:
        """Change how the named actions take goals, or all if there are no names."""
        names = tuple(map(self.namespace.absolute, self.names))
        change = partial(operate, worker=worker, wait=wait, as_json=self.as_json)
        run(change, self.url, names, self.namespace, mode, self.reason)


def lever_options(function: Callable[..., NoReturn]) -> Callable[..., NoReturn]:
    """Add the arguments and options of all levers to a verb. The function gets a `Lever`."""

    @wraps(function)
    def command(
        names: tuple[str, ...],
        reason: str,
        namespace: Namespace,
        as_json: bool,
        url: str,
        **own: Any,
    ) -> NoReturn:
        function(Lever(names, reason, namespace, as_json, url), **own)

    reason_help = "Why: it is told with each rejection, and noted."
    command = namespace_option(json_option(url_option(command)))
    command = click.option("--reason", metavar="TEXT", default="", help=reason_help)(command)
    return click.argument("names", metavar="[NAME]...", type=ACTION, nargs=-1)(command)


@click.command(
    "pause",
    epilog="""\b
Examples:
  fibaction pause drive --reason "the floor is wet"
  fibaction pause drive --refuse""",
)
@all_option
@click.option("--refuse", is_flag=True, help="Reject new goals as busy, instead of letting wait.")
@lever_options
def pause_command(lever: Lever, every: bool, refuse: bool) -> NoReturn:
    """Pause the actions NAME: goals that run end as usual, and no other goal begins. New goals
    wait until you resume the action, or are rejected with --refuse. All workers of a fleet pause,
    and a server with a store stays paused when it is started again.

    You need the permission OPERATE. Your name and the reason are noted.
    """
    lever.check_names(every=every)
    lever.move(IntakeMode.REFUSE if refuse else IntakeMode.HOLD)


@click.command("resume", epilog="\b\nExample:\n  fibaction resume drive")
@all_option
@worker_option
@lever_options
def resume_command(lever: Lever, every: bool, worker: str) -> NoReturn:
    """Let the actions NAME take goals again. A server that drains and is paused has only the drain
    ended; resume it once more.
    """
    lever.check_names(every=every)
    lever.move(IntakeMode.OPEN, worker=worker)


@click.command(
    "drain",
    epilog="""\b
Examples:
  fibaction drain --wait 600
  fibaction drain --worker arm-1 -u nats://127.0.0.1/robots""",
)
@worker_option
@click.option(
    "--wait", metavar="SECONDS", type=NumberType(), help="Wait so long until no goal is active."
)
@lever_options
def drain_command(lever: Lever, worker: str, wait: float | None) -> NoReturn:
    """Drain a server, or one worker of a fleet, before you stop it: it rejects new goals as busy,
    but for steps of active ones, and the others run to their ends. With NAME, only those actions.

    It ends with the process, or when you resume the actions. With --wait, the exit code is 5 if
    goals are still active after that time.
    """
    lever.move(IntakeMode.DRAIN, worker=worker, wait=wait or 0.0)


async def operate(
    url: str,
    names: tuple[str, ...],
    namespace: Namespace = ROOT,
    mode: IntakeMode = IntakeMode.OPEN,
    reason: str = "",
    *,
    worker: str = "",
    wait: float = 0.0,
    as_json: bool = False,
) -> int:
    """Change how actions take goals, and print how they do now.

    Raises:
        Failure: A named action is not served.
        ActionError: None of them could be changed.
    """
    change = IntakeChange(mode, reason, by=own_name(), worker=worker)
    async with connect(url) as connection:
        clients = await ActionClients(namespace.narrow(connection), *names).now()
        changed = {
            name: await _change(name, client, change, as_json=as_json)
            for name, client in clients.items()
        }
        if not all(changed.values()):
            return ExitCode.ABORTED
        if wait and not await _ended(clients, worker, wait):
            return ExitCode.TIMED_OUT
    return ExitCode.SUCCEEDED


async def _change(name: str, client: AnyClient, change: IntakeChange, *, as_json: bool) -> bool:
    """Change how one action takes goals; return whether that was done."""
    try:
        intake = await client.endpoint.change_intake(change)
    except ActionError as exc:
        note(f"{shown(name)}: {message_of(exc)}")
        return False
    if as_json:
        say_json({"action": name, **msgspec.to_builtins(intake)})
    else:
        say(f"{excerpt(shown(name))}: {intake.text or 'takes goals'}")
    return True


async def _ended(clients: dict[str, AnyClient], worker: str, seconds: float) -> bool:
    """Wait until no goal is active, and return whether that came in time."""

    def is_left(info: GoalInfo) -> bool:
        return info.status.is_active and worker in ("", info.worker)

    left = math.inf
    with anyio.move_on_after(seconds):
        while True:
            infos = [info for client in clients.values() for info in await client.goals()]
            left = sum(map(is_left, infos))
            if not left:
                return True
            await anyio.sleep(GOALS_PAUSE)
    note(f"{left:.0f} goals are still active" if left < math.inf else "the server did not answer")
    return False


def own_name() -> str:
    """Return the name of the user and of this machine, for the record of the server."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a container whose user has no name
        user = "?"
    return f"{user}@{socket.gethostname()}"

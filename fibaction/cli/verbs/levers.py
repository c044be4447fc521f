"""`fibaction cancel`, `pause`, `resume` and `drain`: the levers of an operator."""

from __future__ import annotations

import getpass
import math
import socket
import time
from collections.abc import Callable
from functools import partial, wraps
from typing import Any, NamedTuple, NoReturn

import anyio
import click
import msgspec

from fibaction._api import connect
from fibaction.cli.arguments.completion import ACTION, ACTION_OR_GOAL_ID, namespace_option
from fibaction.cli.arguments.goal_lookup import (
    ACTIONS_ASKED_AT_ONCE,
    ActionClients,
    find_goal,
    goal_digits,
    goals_of,
)
from fibaction.cli.arguments.names import ROOT, Namespace, shown
from fibaction.cli.arguments.options import NumberType, json_option, url_option
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.goal_table import GoalRow
from fibaction.cli.output.lines import note, say, say_json
from fibaction.cli.process.exit_codes import ExitCode, Failure, message_of, reason_of, run
from fibaction.observe.monitor import AnyClient
from fibaction.words.errors import ActionError, UnknownGoal
from fibaction.words.goal_query import cancel_stamp_of
from fibaction.words.goals import CancelAnswer, CancelCode, GoalID, GoalInfo
from fibaction.words.intake import IntakeChange, IntakeMode
from fibaction.words.statuses import GoalStatus


class _Stamp(click.ParamType[int]):
    """A time: nanoseconds since 1970, as stamps are, ISO 8601, or a time ago."""

    name = "stamp"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> int:
        try:
            return cancel_stamp_of(value, time.time_ns(), is_local=True)
        except ValueError as exc:
            self.fail(str(exc))


@click.command(
    "cancel",
    epilog="""\b
Examples:
  fibaction cancel 5fda41e0
  fibaction cancel fibonacci --all
  fibaction cancel --before 2026-01-31T12:00:00
  fibaction cancel drive --before 10m

Exit code 1: a goal was not canceled: the server rejected the cancel, or the goal had ended.""",
)
@click.argument("words", nargs=-1, metavar="[NAME] [GOAL_ID]", type=ACTION_OR_GOAL_ID)
@click.option("--all", "everything", is_flag=True, help="Cancel all goals.")
@click.option(
    "--before",
    type=_Stamp(),
    metavar="STAMP",
    help="Cancel the goals that were accepted at or before that time.",
)
@namespace_option
@json_option
@url_option
def cancel_command(
    words: tuple[str, ...],
    everything: bool,
    before: int | None,
    namespace: Namespace,
    as_json: bool,
    url: str,
) -> None:
    """Cancel a goal of any client, or many, of the action NAME or of all actions.

    The beginning of a GOAL_ID is enough if it is unique. STAMP is in nanoseconds since 1970, as
    `goals --json` prints it, or a time such as 2026-01-31T12:00:00Z, or an age such as 10m. The
    command does not wait for the end of the goals.
    """
    if everything and before is not None:
        raise click.UsageError("--all and --before cannot be combined")
    many = everything or before is not None
    if len(words) > (1 if many else 2):
        raise click.UsageError("there is more than NAME and GOAL_ID, or a GOAL_ID with --all")
    if not words and not many:
        raise click.UsageError("no goal is named: give a GOAL_ID, --all or --before STAMP")
    if many:
        name = namespace.absolute(words[0]) if words else None
        run(cancel_many, url, name, before, namespace, as_json=as_json)
    else:
        name = namespace.absolute(words[0]) if len(words) == 2 else None
        try:
            digits = goal_digits(words[-1])
        except Failure as exc:
            raise Failure(f"{exc.message}; --all means all") from exc
        run(cancel_one, url, name, digits, namespace, as_json=as_json)


async def cancel_one(
    url: str, name: str | None, digits: str, namespace: Namespace = ROOT, *, as_json: bool
) -> int:
    """Cancel the goal whose ID begins so, and return the exit code.

    Raises:
        Failure, ActionError: There is no such goal, or the server cannot be asked.
    """
    async with connect(url) as connection:
        clients = await ActionClients(namespace.narrow(connection, name), name).now()
        action, goal_id = await find_goal(clients, digits)
        answer = await clients[action].cancel_goals(goal_id)
    if answer.return_code is CancelCode.UNKNOWN_GOAL_ID:
        raise UnknownGoal(goal_id)
    return _print_answer(action, [goal_id], answer, as_json)


async def cancel_many(
    url: str, name: str | None, before: int | None, namespace: Namespace = ROOT, *, as_json: bool
) -> int:
    """Cancel all goals, or those up to a stamp, and return the exit code.

    Raises:
        Failure, ActionError: The server cannot be asked.
    """
    codes = {ExitCode.SUCCEEDED}
    found = 0

    async def ask(action: str, client: AnyClient) -> None:
        nonlocal found
        mine = (row for row in rows if row.action == action)
        meant = [row.info.goal_id for row in mine if _is_meant(row, before)]
        try:
            async with limit:
                answer = await client.cancel_goals(before=before)
        except ActionError as exc:
            note(f"The goals of {excerpt(shown(action))} are not canceled: {message_of(exc)}")
            codes.add(ExitCode.UNREACHABLE)
            return
        found += len({*meant, *(info.goal_id for info in answer.goals_canceling)})
        codes.add(_print_answer(action, meant, answer, as_json))

    limit = anyio.CapacityLimiter(ACTIONS_ASKED_AT_ONCE)
    async with connect(url) as connection:
        clients = await ActionClients(namespace.narrow(connection, name), name).now()
        rows = await goals_of(clients)
        # Concurrently: a slow server must not delay the cancels at the others.
        async with anyio.create_task_group() as tasks:
            for action, client in clients.items():
                tasks.start_soon(ask, action, client)
    if not found and ExitCode.UNREACHABLE not in codes:
        note("There is no goal to cancel.")
    return max(codes)


def _is_meant(row: GoalRow, before: int | None) -> bool:
    return row.info.status.is_active and (before is None or row.info.stamp <= before)


def _print_answer(
    action: str, goals: list[GoalID], answer: CancelAnswer, as_json: bool
) -> ExitCode:
    """Print the answer for each goal, and return the exit code."""
    canceling = {info.goal_id: info for info in answer.goals_canceling}
    rejected = [goal_id for goal_id in goals if goal_id not in canceling]
    why = reason_of(answer)
    for goal_id, info in canceling.items():
        _print_goal(action, goal_id, info.status, "", as_json)
    for goal_id in rejected:
        _print_goal(action, goal_id, None, why, as_json)
    return ExitCode.ABORTED if rejected else ExitCode.SUCCEEDED


def _print_goal(
    action: str, goal_id: GoalID, status: GoalStatus | None, why: str, as_json: bool
) -> None:
    if as_json:
        canceling = status is not None
        goal = {"action": action, "goal_id": str(goal_id)}
        say_json({**goal, "canceling": canceling, "reason": why})
    elif status is not None:
        say(f"Canceling the goal {goal_id} of {excerpt(shown(action))}")
    else:
        note(f"The goal {goal_id} of {excerpt(shown(action))} is not canceled: {why}")


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

"""`fibaction cancel`: cancel goals of any client."""

from __future__ import annotations

import time

import anyio
import click

from fibaction._api import connect
from fibaction.cli.arguments.completion import ACTION_OR_GOAL_ID, namespace_option
from fibaction.cli.arguments.goal_lookup import (
    ACTIONS_ASKED_AT_ONCE,
    ActionClients,
    find_goal,
    goal_digits,
    goals_of,
)
from fibaction.cli.arguments.names import ROOT, Namespace, shown
from fibaction.cli.arguments.options import json_option, url_option
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.goal_table import GoalRow
from fibaction.cli.output.lines import note, say, say_json
from fibaction.cli.process.exit_codes import ExitCode, Failure, message_of, reason_of, run
from fibaction.observe.monitor import AnyClient
from fibaction.words.errors import ActionError, UnknownGoal
from fibaction.words.goal_query import cancel_stamp_of
from fibaction.words.goals import CancelAnswer, CancelCode, GoalID
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

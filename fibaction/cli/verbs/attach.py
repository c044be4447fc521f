"""`fibaction attach`: follow a goal that was sent before."""

from __future__ import annotations

from functools import partial
from typing import Any

import click

from fibaction._api import connect
from fibaction.cli.arguments.completion import ACTION, GOAL_ID, namespace_option
from fibaction.cli.arguments.goal_lookup import ActionClients, find_goal, goal_digits
from fibaction.cli.arguments.namespaces import ROOT, Namespace
from fibaction.cli.arguments.options import full_option, json_option, url_option
from fibaction.cli.output.lines import note
from fibaction.cli.output.render import goal_printer, print_goal
from fibaction.cli.process.exit_codes import ExitCode, run
from fibaction.cli.process.signals import until_interrupted
from fibaction.observe.monitor import AnyClient
from fibaction.types.action import Codec
from fibaction.words.goals import GoalID


@click.command(
    "attach",
    epilog="""\b
Examples:
  fibaction attach 5fda41e0
  fibaction attach 5fda41e0 fibonacci --json""",
)
@click.argument("goal_id", type=GOAL_ID)
@click.argument("name", type=ACTION, required=False)
@namespace_option
@full_option
@json_option
@url_option
def attach_command(
    goal_id: str, name: str | None, namespace: Namespace, full: bool, as_json: bool, url: str
) -> None:
    """Follow a goal that was sent before: its feedback from now on, and its result. The exit code
    is that of send_goal. Ctrl-C leaves the goal running.

    The beginning of a GOAL_ID is enough if it is unique. With NAME, only the goals of that action
    are searched.
    """
    name = None if name is None else namespace.absolute(name)
    run(attach, url, goal_digits(goal_id), name, namespace, full=full, as_json=as_json)


async def attach(
    url: str,
    digits: str,
    name: str | None,
    namespace: Namespace = ROOT,
    *,
    full: bool,
    as_json: bool,
) -> int:
    """Print the events of a goal until it ends, and return the exit code.

    Raises:
        Failure, ActionError: There is no such goal, or it cannot be followed to its end.
    """
    codes = [ExitCode.INTERRUPTED]
    async with connect(url) as connection:
        clients = await ActionClients(namespace.narrow(connection, name), name).now()
        action, goal_id = await find_goal(clients, digits)
        if await until_interrupted(
            partial(_attach, clients[action], goal_id, codes, full, as_json)
        ):
            note(f"The goal {goal_id} was left as it is.")
    return codes[-1]


async def _attach(
    client: AnyClient, goal_id: GoalID, codes: list[ExitCode], full: bool, as_json: bool
) -> None:
    stream = await client.endpoint.feedback(goal_id)
    printer = goal_printer(feedback=True, as_json=as_json, full=full)
    printer.accepted(goal_id, stream.stamp, stream.info.parent)
    codes.append(await print_goal(stream, client.action, printer, live=not full))
    if stream.checkpoint is not None:
        checkpoints: Codec[Any] = Codec(object, f"the checkpoint of goal {goal_id}")
        printer.given_up(checkpoints.decode(stream.checkpoint) if stream.checkpoint else None)

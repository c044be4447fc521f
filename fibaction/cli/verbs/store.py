"""`fibaction store`: work on the file of a store.

`backup` copies one that may be in use, `given_up` lists the goals that were given up, in a file or
in a fleet, and `rerun` runs one of them again.
"""

from __future__ import annotations

import os
from datetime import datetime
from typing import Any
from urllib.parse import urlsplit

import anyio
import click
import msgspec

from fibaction._api import connect
from fibaction.border.goal_store import StoredGoal
from fibaction.border.urls import transport_for, without_settings
from fibaction.cli.arguments.goal_lookup import ActionClients, find_goal, goal_digits
from fibaction.cli.arguments.names import shown
from fibaction.cli.arguments.options import json_option
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.lines import note, say, say_json
from fibaction.cli.output.yaml_text import as_yaml
from fibaction.cli.process.exit_codes import ExitCode, Failure, run
from fibaction.cli.verbs.actions import FLEETS
from fibaction.words.goals import NO_GOAL, GoalID


@click.group("store", epilog="\b\nExample:\n  fibaction store backup goals.db")
def store_command() -> None:
    """Work on the file in which a server keeps its goals."""


@store_command.command(
    "backup",
    short_help="Copy a store to a new file.",
    epilog="""\b
Examples:
  fibaction store backup goals.db
  fibaction store backup goals.db /mnt/backup/monday.db""",
)
@click.argument("file", metavar="FILE", type=click.Path())
@click.argument("target", metavar="[TARGET]", type=click.Path(), required=False)
def backup_command(file: str, target: str | None) -> None:
    """Copy the store in FILE to the new file TARGET, also while its server runs.

    TARGET has the goals of one moment, and needs no other file. Without TARGET, the copy is next
    to FILE, with the time in its name.
    """
    from fibaction.stores._copy import back_up  # sqlite3 would slow down --help

    target = target or _dated(file)
    for name in (target, f"{target}-wal"):  # SQLite would take that for a part of the copy
        if os.path.lexists(name):
            raise Failure(f"{name} exists: name a new file")
    try:
        count = anyio.run(back_up, file, target)
    except OSError as exc:
        raise Failure(f"cannot write {target}: {exc.strerror}") from exc
    say(f"{target} has {count:,} {'goal' if count == 1 else 'goals'}")


@store_command.command(
    "given_up",
    short_help="List the goals that were given up.",
    epilog="""\b
Examples:
  fibaction store given_up goals.db
  fibaction store given_up nats://127.0.0.1/robots --json""",
)
@click.argument("place", metavar="FILE|URL", type=click.Path())
@json_option
def given_up_command(place: str, as_json: bool) -> None:
    """List the goals that a server has given up, in the FILE of its store, or in the fleet at URL:
    each with the reason, the goal itself and its last checkpoint.

    A goal is given up if too many attempts were lost with their process, or if the server does not
    run it again, or cannot read it. It is kept for a week, or as given_up_timeout says.
    """
    run(list_given_up, place, as_json=as_json)


@store_command.command(
    "rerun",
    short_help="Run a goal again that was given up.",
    epilog="""\b
Examples:
  fibaction store rerun goals.db 91c7df2a
  fibaction store rerun tcp://robot:7400 91c7df2a
  fibaction store rerun nats://127.0.0.1/robots 91c7df2a""",
)
@click.argument("place", metavar="FILE|URL", type=click.Path())
@click.argument("goal_id", metavar="GOAL_ID")
def rerun_command(place: str, goal_id: str) -> None:
    """Run the goal GOAL_ID again, which was given up, as a new goal from its last checkpoint.

    No server may use the FILE meanwhile: the next one that starts with it runs the goal. At the URL
    of a server or a fleet it runs at once, if you have the permission OPERATE. The beginning of
    the ID will do.
    """
    at_server = _is_url(place) and urlsplit(place).scheme not in FLEETS
    run(run_again_at if at_server else run_again, place, goal_digits(goal_id))


async def list_given_up(place: str, *, as_json: bool) -> int:
    """Print the goals that were given up."""
    goals = await _given_up(place)
    if not goals and not as_json:
        note(f"No goals were given up at {_named(place)}.")
    for action, goal in goals:
        if as_json:
            say_json({"action": action, **_values(goal)})
        else:
            say(f"{goal.goal_id}  {excerpt(shown(action))}  attempt {goal.attempt}")
            say(as_yaml({"reason": goal.reason, **_contents(goal)}, indent=4))
    return ExitCode.SUCCEEDED


async def run_again(place: str, digits: str) -> int:
    """Run a goal again that was given up.

    Raises:
        Failure: There is no such goal, or more than one.
    """
    found = [one for one in await _given_up(place) if str(one[1].goal_id).startswith(digits)]
    if len(found) != 1:
        what = "no goal" if not found else f"{len(found)} goals"
        raise Failure(
            f"{what} with an ID that begins with {digits} was given up at {_named(place)}"
        )
    action, old = found[0]
    if _is_url(place):
        async with transport_for(place).connect() as connection:
            new = await connection.rerun(action, old.goal_id)
        when = ""
    else:
        from fibaction.stores._journal_file import rerun

        new = await rerun(place, action, old.goal_id)
        when = " when its server starts"
    _say_new(action, old.goal_id, new, when)
    return ExitCode.SUCCEEDED


async def run_again_at(url: str, digits: str) -> int:
    """Run a goal again that a server, which is running, has given up. It may remember the goal no
    more, but with its whole ID every action can be asked.

    Raises:
        Failure: There is no such goal, or more than one.
        ActionError: The server cannot be asked.
    """
    async with connect(url) as connection:
        clients = await ActionClients(connection).now()
        choices = [(name, digits) for name in clients]
        if len(digits) < 2 * len(NO_GOAL):
            action, found = await find_goal(clients, digits)
            choices = [(action, str(found))]
        for action, whole in choices:
            old = GoalID.parse(whole)
            new = await clients[action].endpoint.rerun(old)
            if new is not None:
                _say_new(action, old, new)
                return ExitCode.SUCCEEDED
    raise Failure(
        f"goal {digits} was not given up at {_named(url)}, is not kept any more, or runs again"
    )


def _say_new(action: str, old: GoalID, new: GoalID, when: str = "") -> None:
    say(f"goal {old} of {excerpt(shown(action))} runs again as goal {new}{when}")


async def _given_up(place: str) -> list[tuple[str, StoredGoal]]:
    """Return the goals that were given up, each with its action.

    Raises:
        Failure: The URL is not that of a fleet.
    """
    if _is_url(place):
        if urlsplit(place).scheme not in FLEETS:
            raise Failure(
                f"{_named(place)} is one server: give the file of its store, such as goals.db, or"
                f" the URL of a fleet, such as nats://127.0.0.1/robots"
            )
        async with transport_for(place).connect() as connection:
            found = await connection.given_up()
    else:
        from fibaction.stores._copy import stored_goals  # sqlite3 would slow down --help

        found = await stored_goals(place)
    return [(action, goal) for action, goals in found.items() for goal in goals if goal.is_given_up]


def _contents(goal: StoredGoal) -> dict[str, Any]:
    contents = {"goal": msgspec.msgpack.decode(goal.goal)}
    if goal.checkpoint is not None:
        contents["checkpoint"] = msgspec.msgpack.decode(goal.checkpoint)
    return contents


def _values(goal: StoredGoal) -> dict[str, Any]:
    return {
        "goal_id": str(goal.goal_id),
        "ended_at": goal.ended_at,
        "attempt": goal.attempt,
        "reason": goal.reason,
        "client": str(goal.sender),
        **_contents(goal),
    }


def _is_url(place: str) -> bool:
    return "://" in place


def _named(place: str) -> str:
    return without_settings(place) if _is_url(place) else place


def _dated(file: str) -> str:
    name, ending = os.path.splitext(file)
    return f"{name}-{datetime.now():%Y-%m-%dT%H-%M-%S}{ending}"

"""`fibaction info` and `type`: show an action as `ros2 action` does, and a template of its goal."""

from __future__ import annotations

import click

from fibaction._api import connect
from fibaction.cli.arguments.action_names import find_action, no_action, shown
from fibaction.cli.arguments.completion import ACTION, namespace_option
from fibaction.cli.arguments.goal_template import GoalTemplate
from fibaction.cli.arguments.namespaces import Namespace
from fibaction.cli.arguments.options import json_option, url_option
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.lines import say, say_json
from fibaction.cli.process.exit_codes import ExitCode, Failure, run
from fibaction.cli.verbs.list import (
    count_option,
    intake_json,
    intakes_at,
    types_option,
    with_type,
)
from fibaction.types.action import ActionInfo
from fibaction.words.errors import ServerNotFound

LONGEST_TEXT = 20
"""Lines of the description of an action."""


@click.command("info", epilog="\b\nExample:\n  fibaction info fibonacci")
@click.argument("name", type=ACTION)
@types_option
@count_option
@namespace_option
@json_option
@url_option
def info_command(
    name: str, show_types: bool, count: bool, namespace: Namespace, as_json: bool, url: str
) -> None:
    """Show what the action NAME does, its servers and its clients, and its goal as a template to
    fill in. With --json, also the JSON Schemas of its goal, feedback and result.
    """
    options = {"show_types": show_types, "count": count, "as_json": as_json}
    run(print_info, url, namespace.absolute(name), **options)


async def print_info(url: str, name: str, *, show_types: bool, count: bool, as_json: bool) -> int:
    """Print the clients and the servers of an action.

    Raises:
        Failure: It has neither.
    """
    async with connect(url) as connection:
        actions = await connection.actions()
        found = [info for info in actions if shown(info.name) == shown(name)]
        info = found[0] if found else ActionInfo(name)
        try:
            peers = await connection.peers(info.name)
        except (ServerNotFound, UnicodeError) as exc:  # a name that is not text has no server
            raise no_action(name, actions) from exc
        intake = (await intakes_at(connection, found)).get(info.name)
        release = connection.release
    if not (found or peers.servers or peers.clients):
        raise no_action(name, actions)
    if as_json:
        schemas: dict[str, object] = {
            "goal": info.goal,
            "feedback": info.feedback,
            "result": info.result,
            "template": GoalTemplate(info.goal).goal,
            "description": info.description,
            "version": release,
        }
        names = {"clients": peers.clients, "servers": peers.servers}
        more = {} if count else schemas | intake_json(intake)
        say_json({"name": info.name, "type": info.type_name, **names, **more})
        return ExitCode.SUCCEEDED
    say(f"Action: {excerpt(shown(info.name))}")
    for line in () if count else info.description.splitlines()[:LONGEST_TEXT]:
        say(f"    {excerpt(line)}".rstrip())
    for role, peer_names in (("clients", peers.clients), ("servers", peers.servers)):
        say(f"Action {role}: {len(peer_names)}")
        for one in () if count else peer_names:
            say(f"    {with_type(one, info.type_name if show_types else '')}")
    if release and not count:
        say(f"Version of fibaction: {excerpt(release)}")
    if intake is not None and not count:
        if intake.schedule is not None:
            say(f"Schedule: {intake.schedule.text}")
        if intake.text:
            say(f"Intake: {intake.text}")
    if info.goal and not count:
        say("Goal:")
        for line in GoalTemplate(info.goal).lines():
            say(f"    {line}")
    return ExitCode.SUCCEEDED


@click.command("type", epilog="\b\nExample:\n  fibaction type fibonacci")
@click.argument("name", type=ACTION)
@json_option
@url_option
def type_command(name: str, as_json: bool, url: str) -> None:
    """Print the type of the action NAME, as package/action/Type."""
    run(print_type, url, name, as_json=as_json)


async def print_type(url: str, name: str, *, as_json: bool) -> int:
    """Print the type of an action.

    Raises:
        Failure: The action is not served, or its server does not tell its type.
    """
    async with connect(url) as connection:
        info = await find_action(connection, name)
    if as_json:
        say_json({"name": info.name, "type": info.type_name})
    elif info.type_name:
        say(excerpt(info.type_name))
    else:
        raise Failure(f"the server of {shown(info.name)} does not say its type", ExitCode.ABORTED)
    return ExitCode.SUCCEEDED

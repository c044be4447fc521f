"""`fibaction list`, `info`, `type` and `find`: what there is, as `ros2 action` tells it."""

from __future__ import annotations

from collections.abc import Collection

import click

from fibaction._api import connect
from fibaction.action import ActionInfo
from fibaction.cli.app import find_action, json_option, no_action, run, shown, url_option
from fibaction.cli.completing import ACTION, TYPE
from fibaction.cli.ending import ExitCode, Failure
from fibaction.cli.escaping import clean
from fibaction.cli.output import say, say_json
from fibaction.exceptions import ServerNotFound

_types_option = click.option("-t", "--show-types", is_flag=True, help="Show the types, too.")
_count_option = click.option(
    "-c", "--count", "--count-actions", "count", is_flag=True, help="Show only how many there are."
)


# list


@click.command("list", epilog="\b\nExample:\n  fibaction list -t")
@_types_option
@_count_option
@json_option
@url_option
def list_command(show_types: bool, count: bool, as_json: bool, url: str) -> None:
    """List the actions that are served."""
    run(list_actions, url, show_types=show_types, count=count, as_json=as_json)


async def list_actions(url: str, *, show_types: bool, count: bool, as_json: bool) -> int:
    """Print the names of the actions, one a line, or how many there are."""
    async with connect(url) as connection:
        actions = await connection.actions()
    _say_actions(actions, show_types=show_types, count=count, as_json=as_json)
    return ExitCode.SUCCEEDED


# find


@click.command("find", epilog="\b\nExample:\n  fibaction find arduinobot_msgs/action/Fibonacci")
@click.argument("type_name", metavar="TYPE", type=TYPE)
@_count_option
@json_option
@url_option
def find_command(type_name: str, count: bool, as_json: bool, url: str) -> None:
    """List the actions of the type TYPE, written as package/action/Type."""
    run(find, url, type_name, count=count, as_json=as_json)


async def find(url: str, type_name: str, *, count: bool, as_json: bool) -> int:
    """Print the names of the actions of a type, one a line, or how many there are."""
    async with connect(url) as connection:
        actions = await connection.actions()
    found = [info for info in actions if info.type_name == type_name]
    _say_actions(found, show_types=False, count=count, as_json=as_json)
    return ExitCode.SUCCEEDED


# type


@click.command("type", epilog="\b\nExample:\n  fibaction type fibonacci")
@click.argument("name", type=ACTION)
@json_option
@url_option
def type_command(name: str, as_json: bool, url: str) -> None:
    """Say the type of the action NAME, as package/action/Type."""
    run(say_type, url, name, as_json=as_json)


async def say_type(url: str, name: str, *, as_json: bool) -> int:
    """Print the type of an action.

    Raises:
        Failure: Nobody serves it, or its server does not say.
    """
    async with connect(url) as connection:
        info = await find_action(connection, name)
    if as_json:
        say_json({"name": info.name, "type": info.type_name})
    elif info.type_name:
        say(clean(info.type_name))
    else:
        raise Failure(f"the server of {shown(info.name)} does not say its type", ExitCode.ABORTED)
    return ExitCode.SUCCEEDED


# info


@click.command("info", epilog="\b\nExample:\n  fibaction info fibonacci")
@click.argument("name", type=ACTION)
@_types_option
@_count_option
@json_option
@url_option
def info_command(name: str, show_types: bool, count: bool, as_json: bool, url: str) -> None:
    """Say who serves the action NAME, and who uses it. With --json, also what a goal, a feedback
    and a result consist of, as JSON Schemas.
    """
    run(say_info, url, name, show_types=show_types, count=count, as_json=as_json)


async def say_info(url: str, name: str, *, show_types: bool, count: bool, as_json: bool) -> int:
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
        except ServerNotFound as exc:
            raise no_action(name, actions) from exc
    if not (found or peers.servers or peers.clients):
        raise no_action(name, actions)
    if as_json:
        schemas = {"goal": info.goal, "feedback": info.feedback, "result": info.result}
        who = {"clients": peers.clients, "servers": peers.servers}
        say_json({"name": info.name, "type": info.type_name, **who, **({} if count else schemas)})
        return ExitCode.SUCCEEDED
    say(f"Action: {clean(shown(info.name))}")
    for role, names in (("clients", peers.clients), ("servers", peers.servers)):
        say(f"Action {role}: {len(names)}")
        for one in () if count else names:
            say(f"    {_line(one, info.type_name if show_types else '', exact=True)}")
    return ExitCode.SUCCEEDED


# Lines


def _say_actions(
    actions: Collection[ActionInfo], *, show_types: bool, count: bool, as_json: bool
) -> None:
    """The actions in the order of their names, or how many there are."""
    if count:
        _say_count(len(actions), as_json)
        return
    for info in sorted(actions, key=lambda info: shown(info.name)):
        if as_json:
            say_json({"name": info.name, "type": info.type_name})
        else:
            say(_line(info.name, info.type_name if show_types else ""))


def _line(name: str, type_name: str = "", *, exact: bool = False) -> str:
    """A name, and its type in brackets."""
    line = clean(name if exact else shown(name))
    return f"{line} [{clean(type_name)}]" if type_name else line


def _say_count(number: int, as_json: bool) -> None:
    if as_json:
        say_json({"count": number})
    else:
        say(str(number))

"""`fibaction list` and `find`: list all actions, or those of a type, as `ros2 action` does."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import suppress
from itertools import groupby
from types import MappingProxyType

import click
import msgspec

from fibaction._api import ClientConnection, connect
from fibaction.border.endpoints import Endpoint
from fibaction.cli.arguments.action_names import is_type, shown
from fibaction.cli.arguments.completion import TYPE, namespace_option
from fibaction.cli.arguments.namespaces import ROOT, Namespace, namespace_of
from fibaction.cli.arguments.options import json_option, url_option
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.lines import note, say, say_json
from fibaction.cli.process.exit_codes import ExitCode, run
from fibaction.feeds.intakes import intakes_of
from fibaction.types.action import Action, ActionInfo
from fibaction.words.errors import ActionError
from fibaction.words.intake import Intake

types_option = click.option("-t", "--show-types", is_flag=True, help="Show the types, too.")
count_option = click.option(
    "-c", "--count", "--count-actions", "count", is_flag=True, help="Show only the number."
)


@click.command(
    "list",
    epilog="""\b
Examples:
  fibaction list -t
  fibaction list -n /robot1
  fibaction list --group""",
)
@types_option
@count_option
@namespace_option
@click.option("-g", "--group", is_flag=True, help="Show each namespace, and its actions below it.")
@json_option
@url_option
def list_command(
    show_types: bool, count: bool, namespace: Namespace, group: bool, as_json: bool, url: str
) -> None:
    """List the actions that are served."""
    settings = {"show_types": show_types, "count": count, "as_json": as_json}
    run(list_actions, url, namespace, group=group, **settings)


async def list_actions(
    url: str,
    namespace: Namespace = ROOT,
    *,
    group: bool = False,
    show_types: bool,
    count: bool,
    as_json: bool,
) -> int:
    """Print the names of the actions, one a line, or their number.

    Raises:
        Failure: The namespace has no actions.
    """
    async with connect(url) as connection:
        actions = await namespace.narrow(connection).actions()
        intakes = {} if count else await intakes_at(connection, actions)
    if group:
        print_groups(actions, show_types=show_types, count=count, as_json=as_json)
    else:
        print_actions(actions, show_types=show_types, count=count, as_json=as_json, intakes=intakes)
    for name in sorted(intakes, key=shown) if not as_json else ():
        if text := intakes[name].text:
            note(f"{shown(name)}: {text}")
    return ExitCode.SUCCEEDED


async def intakes_at(
    connection: ClientConnection, actions: Collection[ActionInfo]
) -> dict[str, Intake]:
    """Return how actions take goals, as far as their servers tell it in time."""
    endpoints: list[Endpoint] = []
    for info in actions:
        with suppress(ActionError):  # its type is not known here
            endpoints.append(connection.client(Action.untyped(info)).endpoint)
    return await intakes_of(endpoints)


@click.command("find", epilog="\b\nExample:\n  fibaction find arduinobot_msgs/action/Fibonacci")
@click.argument("type_name", metavar="TYPE", type=TYPE)
@count_option
@json_option
@url_option
def find_command(type_name: str, count: bool, as_json: bool, url: str) -> None:
    """List the actions of the type TYPE, written as package/action/Type."""
    run(find, url, type_name, count=count, as_json=as_json)


async def find(url: str, type_name: str, *, count: bool, as_json: bool) -> int:
    """Print the names of the actions of a type, one a line, or their number."""
    async with connect(url) as connection:
        actions = await connection.actions()
    found = [info for info in actions if is_type(type_name, info.type_name)]
    print_actions(found, show_types=False, count=count, as_json=as_json)
    return ExitCode.SUCCEEDED


def print_actions(
    actions: Collection[ActionInfo],
    *,
    show_types: bool,
    count: bool,
    as_json: bool,
    intakes: Mapping[str, Intake] = MappingProxyType({}),
) -> None:
    """Print the actions in the order of their names, or their number."""
    if count:
        number = len(actions)
        say_json({"count": number}) if as_json else say(str(number))
        return
    for info in sorted(actions, key=lambda info: shown(info.name)):
        if as_json:
            say_json(_json(info) | intake_json(intakes.get(info.name)))
        else:
            say(with_type(shown(info.name), info.type_name if show_types else ""))


def print_groups(
    actions: Collection[ActionInfo], *, show_types: bool, count: bool, as_json: bool
) -> None:
    """Print each namespace, and below it its actions, or behind it their number."""

    def key(info: ActionInfo) -> tuple[str, str]:
        return namespace_of(info.name), shown(info.name)

    for namespace, group in groupby(sorted(actions, key=key), key=lambda info: key(info)[0]):
        infos = list(group)
        if as_json:
            for value in [{"count": len(infos)}] if count else map(_json, infos):
                say_json({"namespace": namespace, **value})
            continue
        say(f"{excerpt(namespace)}{f': {len(infos)}' if count else ''}")
        for info in () if count else infos:
            name = shown(info.name).rpartition("/")[2]
            say(f"    {with_type(name, info.type_name if show_types else '')}")


def intake_json(intake: Intake | None) -> dict[str, object]:
    """Return how an action takes goals, if that is not as usual, and its schedule, for programs."""
    if intake is None:
        return {}
    told: dict[str, object] = {"intake": intake.mode.value} if intake.text else {}
    if intake.schedule is not None:
        told["schedule"] = msgspec.to_builtins(intake.schedule)
    return told


def _json(info: ActionInfo) -> dict[str, object]:
    return {"name": info.name, "type": info.type_name}


def with_type(name: str, type_name: str) -> str:
    """Return a name with its type in brackets, if there is one."""
    return f"{excerpt(name)} [{excerpt(type_name)}]" if type_name else excerpt(name)

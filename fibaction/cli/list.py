"""`fibaction list`: list the actions that are served, as `ros2 action list` prints them."""

from __future__ import annotations

from collections.abc import Collection

import click

from fibaction._api import connect
from fibaction.action import ActionInfo
from fibaction.cli.action_names import shown
from fibaction.cli.escape import excerpt
from fibaction.cli.exit_codes import ExitCode, run
from fibaction.cli.options import json_option, url_option
from fibaction.cli.output import say, say_json

types_option = click.option("-t", "--show-types", is_flag=True, help="Show the types, too.")
count_option = click.option(
    "-c", "--count", "--count-actions", "count", is_flag=True, help="Show only the number."
)


@click.command("list", epilog="\b\nExample:\n  fibaction list -t")
@types_option
@count_option
@json_option
@url_option
def list_command(show_types: bool, count: bool, as_json: bool, url: str) -> None:
    """List the actions that are served."""
    run(list_actions, url, show_types=show_types, count=count, as_json=as_json)


async def list_actions(url: str, *, show_types: bool, count: bool, as_json: bool) -> int:
    """Print the names of the actions, one a line, or their number."""
    async with connect(url) as connection:
        actions = await connection.actions()
    print_actions(actions, show_types=show_types, count=count, as_json=as_json)
    return ExitCode.SUCCEEDED


def print_actions(
    actions: Collection[ActionInfo], *, show_types: bool, count: bool, as_json: bool
) -> None:
    """Print the actions in the order of their names, or their number."""
    if count:
        number = len(actions)
        say_json({"count": number}) if as_json else say(str(number))
        return
    for info in sorted(actions, key=lambda info: shown(info.name)):
        if as_json:
            say_json({"name": info.name, "type": info.type_name})
        else:
            say(with_type(shown(info.name), info.type_name if show_types else ""))


def with_type(name: str, type_name: str) -> str:
    """Return a name with its type in brackets, if there is one."""
    return f"{excerpt(name)} [{excerpt(type_name)}]" if type_name else excerpt(name)

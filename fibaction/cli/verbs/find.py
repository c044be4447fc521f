"""`fibaction find`: list the actions of a type, as `ros2 action find` prints them."""

from __future__ import annotations

import click

from fibaction._api import connect
from fibaction.cli.arguments.completion import TYPE
from fibaction.cli.arguments.options import json_option, url_option
from fibaction.cli.process.exit_codes import ExitCode, run
from fibaction.cli.verbs.list import count_option, print_actions


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
    found = [info for info in actions if info.type_name == type_name]
    print_actions(found, show_types=False, count=count, as_json=as_json)
    return ExitCode.SUCCEEDED

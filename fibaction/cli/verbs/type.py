"""`fibaction type`: print the type of an action, as `ros2 action type` does."""

from __future__ import annotations

import click

from fibaction._api import connect
from fibaction.cli.arguments.action_names import find_action, shown
from fibaction.cli.arguments.completion import ACTION
from fibaction.cli.arguments.options import json_option, url_option
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.lines import say, say_json
from fibaction.cli.process.exit_codes import ExitCode, Failure, run


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

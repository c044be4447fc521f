"""Names of actions: how they are shown, looked up and suggested."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING

from fibaction._runtime.text import nearest
from fibaction.cli.output.escape import excerpt
from fibaction.cli.process.exit_codes import ExitCode, Failure

if TYPE_CHECKING:
    from fibaction.border.abc import Connection, Endpoint
    from fibaction.types.action import ActionInfo

MOST_SUGGESTED = 10
"""Names that an error lists where none of them is similar."""


async def find_action(connection: Connection, name: str) -> ActionInfo:
    """Return the action of that name. A slash in front is optional.

    Raises:
        Failure: It is not served. The code is `UNREACHABLE`, since a wrong name and a server that
            has not started cannot be told apart on a network of servers.
    """
    return action_of(name, await connection.actions())


def action_of(name: str, actions: Collection[ActionInfo]) -> ActionInfo:
    """Return the action of that name. A slash in front is optional.

    Raises:
        Failure: It is not among them; the code is that of `find_action`.
    """
    wanted = shown(name)
    for info in actions:
        if shown(info.name) == wanted:
            return info
    raise no_action(name, actions)


def is_type(given: str, type_name: str) -> bool:
    """Return whether a user means this type: by its whole name, with a slash in front or not, by
    package and type, or by the type alone.
    """
    known = type_name.split("/")
    parts = re.split(r"/|\.|::", given.removeprefix("/"))
    return bool(given) and parts in (known, [known[0], known[-1]], known[-1:])


def no_action(name: str, actions: Iterable[ActionInfo]) -> Failure:
    """Return the error for an action that is not served, with the most similar name."""
    known = sorted(excerpt(shown(info.name)) for info in actions)
    text = f"the action {shown(name)} is not served"
    if near := nearest(shown(name), known):
        text += f"; did you mean {near}?"
    elif known:
        some = known[:MOST_SUGGESTED]
        text += f"; there is {', '.join(some)}{', ...' if len(known) > len(some) else ''}"
    else:
        text += ", nor is any other"
    return Failure(text, ExitCode.UNREACHABLE)


def shown(name: str) -> str:
    """Return an action's name as `ros2 action` prints it: with a slash in front."""
    return name if name.startswith(("/", "~")) else f"/{name}"


def names_of(endpoints: Iterable[Endpoint]) -> str:
    """Return the names of actions as one text."""
    return ", ".join(excerpt(shown(endpoint.info.name)) for endpoint in endpoints)

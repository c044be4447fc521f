"""Completion of action names and types in the shell, from the server that the URL names.

Verbs and options are completed by click itself. A server that does not answer within `TIMEOUT`
completes nothing, since a user waits at a prompt.

The scripts of the shells insert names unquoted, and a server may send any name. So only names that
mean themselves in every shell are completed. All names that follow ROS's rule do, except those with
a `~`.
"""

from __future__ import annotations

import re
from itertools import islice
from typing import TYPE_CHECKING

import anyio
import click
from click.shell_completion import CompletionItem

from fibaction._api import connect
from fibaction.cli.action_names import shown
from fibaction.cli.options import url_of
from fibaction.exceptions import ActionError

if TYPE_CHECKING:
    from fibaction.action import ActionInfo

TIMEOUT = 5.0
"""Seconds for the answer of a server."""
MOST = 1000
"""Actions whose names are completed."""

_PLAIN = re.compile(r"[A-Za-z0-9_/]{0,200}", re.ASCII)


class _ActionName(click.ParamType[str]):
    """The name of an action."""

    name = "action"

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        slash = incomplete.startswith("/")
        names = [shown(info.name) if slash else info.name for info in reachable(url_of(ctx))]
        return [CompletionItem(name) for name in names if name.startswith(incomplete)]


class _TypeName(click.ParamType[str]):
    """The type of an action; of the one that is named before it, if any."""

    name = "type"

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        named = ctx.params.get("name")
        types = {
            info.type_name
            for info in reachable(url_of(ctx))
            if info.type_name and named in (None, info.name, shown(info.name))
        }
        return [CompletionItem(one) for one in sorted(types) if one.startswith(incomplete)]


ACTION = _ActionName()
TYPE = _TypeName()


def reachable(url: str) -> list[ActionInfo]:
    """Return the actions at a URL whose names and types mean themselves in a shell.

    There are none if the server cannot be asked.
    """
    try:
        infos = anyio.run(actions_at, url)
    except ActionError:
        return []
    plain = (info for info in infos if _PLAIN.fullmatch(info.name))
    return list(islice((info for info in plain if _PLAIN.fullmatch(info.type_name)), MOST))


async def actions_at(url: str) -> list[ActionInfo]:
    """Return the actions at a URL; none if there is no answer within `TIMEOUT`.

    Raises:
        ActionError: There is no server, or the URL cannot be used.
    """
    with anyio.move_on_after(TIMEOUT):
        async with connect(url) as connection:
            return await connection.actions()
    return []

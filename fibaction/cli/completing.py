"""What the shell completes: the actions of a server that can be reached, and their types.

Verbs and options are completed by click itself. A server that does not answer soon completes
nothing; somebody waits at a prompt.
"""

from __future__ import annotations

import anyio
import click
from click.shell_completion import CompletionItem

from fibaction._api import connect
from fibaction.action import ActionInfo
from fibaction.cli.app import shown, url_of
from fibaction.exceptions import ActionError

PATIENCE = 5.0
"""Seconds that a server has to answer."""


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
    """The type of an action; of the one that is named before it, where there is one."""

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
    """The actions at a URL that can be typed; none if it cannot be said soon."""
    try:
        infos = anyio.run(actions_at, url)
    except ActionError:
        return []
    return [info for info in infos if f"{info.name}{info.type_name}".isprintable()]


async def actions_at(url: str) -> list[ActionInfo]:
    """The actions at a URL; none if there is no answer within `PATIENCE`.

    Raises:
        ActionError: There is nobody, or the URL cannot be used.
    """
    with anyio.move_on_after(PATIENCE):
        async with connect(url) as connection:
            return await connection.actions()
    return []

"""Completion in the shell from the server that the URL names: names and types of actions, goals to
fill in, and IDs of goals.

Verbs and options are completed by click itself. A server that does not answer within `ASK_TIMEOUT`
completes nothing, since a user waits at a prompt.

The scripts of the shells insert names unquoted, and a server may send any name. So only names that
mean themselves in every shell are completed. All names that follow ROS's rule do, except those with
a `~`. A goal is quoted for bash; zsh and fish quote by themselves.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from itertools import islice
from typing import TYPE_CHECKING, Any

import anyio
import click
from click.shell_completion import CompletionItem

from fibaction._api import connect
from fibaction.cli.arguments.goal_lookup import ActionClients, goals_of
from fibaction.cli.arguments.goal_text import GoalTemplate
from fibaction.cli.arguments.names import ROOT, Namespace, namespaces_of, shown
from fibaction.cli.arguments.options import FunctionT, url_of
from fibaction.cli.process.exit_codes import Failure
from fibaction.words.errors import ActionError

if TYPE_CHECKING:
    from fibaction.cli.output.goal_table import GoalRow
    from fibaction.types.action import ActionInfo

ASK_TIMEOUT = 5.0
"""Seconds for the answer of a server."""
MOST_OFFERED = 1000
"""Actions whose names are completed, and goals."""

_PLAIN = re.compile(r"[A-Za-z0-9_/]{0,200}", re.ASCII)


class _ActionName(click.ParamType[str]):
    """The name of an action."""

    name = "action"

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        names = [info.name for info in actions_for(ctx)]
        if incomplete.startswith("/"):
            names = list(map(shown, names))
        else:
            namespace: Namespace = ctx.params.get("namespace") or ROOT
            names = [namespace.relative(name) for name in names if namespace.holds(name)]
        return [CompletionItem(name) for name in names if name.startswith(incomplete)]


class _TypeName(click.ParamType[str]):
    """The type of an action; of the one that is named before it, if any."""

    name = "type"

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        types = {info.type_name for info in _named(ctx) if info.type_name}
        return [CompletionItem(one) for one in sorted(types) if one.startswith(incomplete)]


class _TypeOrGoal(_TypeName):
    """The type of the action that is named before it, or a template of its goal."""

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        if incomplete:
            return super().shell_complete(ctx, param, incomplete)
        templates = (GoalTemplate(info.goal).for_shell() for info in _named(ctx) if info.goal)
        return [CompletionItem(_quoted(one)) for one in templates if one]


class _GoalIDOf(_ActionName):
    """The ID of a goal, or the name of an action and then the ID of one of its goals."""

    name = "goal_id"

    def __init__(self, *, actions: bool) -> None:
        self._actions = actions

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        words: tuple[str, ...] = (ctx.params.get(param.name or "") or ()) if self._actions else ()
        names = super().shell_complete(ctx, param, incomplete)
        ids = _goal_ids(ctx, words[0] if words else None, active=self._actions)
        found = [CompletionItem(one) for one in ids if one.startswith(incomplete.lower())]
        return [*names, *found] if self._actions and not words else found


ACTION = _ActionName()
TYPE = _TypeName()
TYPE_OR_GOAL = _TypeOrGoal()
GOAL_ID = _GoalIDOf(actions=False)
ACTION_OR_GOAL_ID = _GoalIDOf(actions=True)


def actions_for(ctx: click.Context) -> list[ActionInfo]:
    """Return the actions that can be completed; none if the server cannot be asked."""
    try:
        return plain(anyio.run(actions_at, url_of(ctx)))
    except (ActionError, Failure):
        return []


def _named(ctx: click.Context) -> list[ActionInfo]:
    """Return the action that is named before the incomplete word; all if none is."""
    named = ctx.params.get("name")
    infos = actions_for(ctx)
    return [info for info in infos if named is None or shown(info.name) == shown(named)]


def _quoted(goal: str) -> str:
    """Return a goal, in which there are no single quotes, as the shell inserts it."""
    return f"'{goal}'" if os.environ.get("_FIBACTION_COMPLETE", "bash").startswith("bash") else goal


def _goal_ids(ctx: click.Context, name: str | None, *, active: bool) -> list[str]:
    """Return the IDs of goals, the newest first; with `active`, of those only.

    There are none if the server cannot be asked.
    """
    try:
        rows = anyio.run(goals_at, url_of(ctx), name)
    except (ActionError, Failure):
        return []
    return [row.goal_id for row in reversed(rows) if row.info.status.is_active or not active][
        :MOST_OFFERED
    ]


async def goals_at(url: str, name: str | None, timeout: float = ASK_TIMEOUT) -> list[GoalRow]:
    """Return the goals of an action, or of all, at a URL; none without an answer in time.

    Raises:
        ActionError: There is no server, or the URL cannot be used.
        Failure: The action is not served.
    """
    with anyio.move_on_after(timeout):
        async with connect(url) as connection:
            return await goals_of(await ActionClients(connection, name).now())
    return []


def plain(infos: Iterable[ActionInfo]) -> list[ActionInfo]:
    """Return the first `MOST_OFFERED` actions whose names and types mean themselves in a shell."""
    named = (info for info in infos if _PLAIN.fullmatch(info.name))
    return list(islice((info for info in named if _PLAIN.fullmatch(info.type_name)), MOST_OFFERED))


async def actions_at(url: str, timeout: float = ASK_TIMEOUT) -> list[ActionInfo]:
    """Return the actions at a URL; none if there is no answer in time.

    Raises:
        ActionError: There is no server, or the URL cannot be used.
    """
    with anyio.move_on_after(timeout):
        async with connect(url) as connection:
            return await connection.actions()
    return []


class _NamespaceType(click.ParamType[Namespace]):
    """A namespace of actions."""

    name = "namespace"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> Namespace:
        return Namespace.parse(value)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        if "from_url" in ctx.params and not ctx.params["from_url"]:
            if not ctx.args:
                return []
            # click has left the arguments aside, since the last option has no value.
            ctx.params["from_url"] = ctx.args[0]
        paths = sorted(namespaces_of(info.name for info in actions_for(ctx)))
        if incomplete and not incomplete.startswith("/"):
            paths = [path.removeprefix("/") for path in paths]
        return [CompletionItem(path) for path in paths if path.startswith(incomplete)]


NAMESPACE = _NamespaceType()
"""The type of an option with a namespace."""


def namespace_option(function: FunctionT) -> FunctionT:
    """Add `--namespace` to a verb. The function gets `namespace`: by default that of all."""
    return click.option(
        "-n",
        "--namespace",
        metavar="NAMESPACE",
        type=NAMESPACE,
        default=ROOT.path,
        help="Only the actions in this namespace, for example /robot1. Names are relative to it.",
    )(function)

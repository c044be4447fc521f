"""The option `--namespace` of the verbs that name or list actions or goals."""

from __future__ import annotations

from typing import Any

import click
from click.shell_completion import CompletionItem

from fibaction.cli.arguments.completion import actions_for
from fibaction.cli.arguments.namespaces import ROOT, Namespace, namespaces_of
from fibaction.cli.arguments.options import FunctionT


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

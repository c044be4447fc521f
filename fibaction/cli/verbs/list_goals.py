"""`fibaction goals`: list goals, once or until Ctrl-C."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

import anyio
import click

from fibaction._api import ClientConnection, connect
from fibaction.cli.arguments.action_names import shown
from fibaction.cli.arguments.completion import ACTION
from fibaction.cli.arguments.goal_lookup import ActionClients, goals_of
from fibaction.cli.arguments.namespace_option import namespace_option
from fibaction.cli.arguments.namespaces import ROOT, Namespace
from fibaction.cli.arguments.options import json_option, url_option
from fibaction.cli.arguments.stored_goals import rows_of_store
from fibaction.cli.output.family import Family
from fibaction.cli.output.goal_table import GoalRow, in_color, in_columns, picture
from fibaction.cli.output.lines import console, note, on_terminal, say, say_json
from fibaction.cli.output.outcomes import Outcomes
from fibaction.cli.process.exit_codes import ExitCode, Failure, message_of, run
from fibaction.cli.process.signals import until_interrupted
from fibaction.cli.verbs.echo import EventPrinter, print_events
from fibaction.cli.verbs.workers import note_unreadable
from fibaction.observe.monitor import AnyClient, newest_active_first
from fibaction.words.errors import ActionError
from fibaction.words.statuses import GoalStatus

UPDATE_PAUSE = 0.5
"""Seconds between two updates of a list that is watched."""
AWAY_TIMEOUT = 1.0
"""Seconds without an answer after which the server is shown as away."""
LIMIT = 100
"""Goals that are listed if nothing else is said."""
ACTIVE = frozenset(status for status in GoalStatus if status.is_active)
ENDED = frozenset(status for status in GoalStatus if status.is_terminal)
STATUSES = {
    "active": ACTIVE,
    "ended": ENDED,
    **{status.name.lower(): frozenset((status,)) for status in (*sorted(ACTIVE), *sorted(ENDED))},
}
"""The statuses that each word of `--status` means."""


class GoalChoice(NamedTuple):
    """The goals of a list that are printed."""

    words: tuple[str, ...] = ()
    """The words for their statuses; none for any."""
    limit: int = 0
    """The most goals; 0 for any number."""

    def of(self, rows: list[GoalRow]) -> tuple[list[GoalRow], int]:
        """Return the chosen rows in their order, and the number of those beyond the limit."""
        statuses = frozenset[GoalStatus]().union(*(STATUSES[word] for word in self.words))
        found = [row for row in rows if not self.words or row.info.status in statuses]
        if not self.limit or len(found) <= self.limit:
            return found, 0
        chosen = sorted(found, key=lambda row: newest_active_first(row.info))[: self.limit]
        return sorted(chosen, key=lambda row: row.info.stamp), len(found) - self.limit


ANY = GoalChoice()
"""All goals."""


@click.command(
    "goals",
    epilog="""\b
Examples:
  fibaction goals
  fibaction goals fibonacci --watch
  fibaction goals --status active --limit 20
  fibaction goals -n /robot1 --json
  fibaction goals --store goals.db""",
)
@click.argument("name", type=ACTION, required=False)
@click.option("-w", "--watch", is_flag=True, help="Continue until Ctrl-C.")
@click.option(
    "--store",
    metavar="FILE",
    help="List the goals in the file of a store, whether its server runs or not.",
)
@click.option(
    "--status",
    "words",
    type=click.Choice(tuple(STATUSES), case_sensitive=False),
    multiple=True,
    help="List the goals with this status only; may be given several times.",
)
@click.option(
    "--limit",
    type=click.IntRange(min=0),
    help=f"List so many goals, the active and the newest ones; 0 for all.  [default: {LIMIT}]",
)
@namespace_option
@json_option
@url_option
def goals_command(
    name: str | None,
    watch: bool,
    store: str | None,
    words: tuple[str, ...],
    limit: int | None,
    namespace: Namespace,
    as_json: bool,
    url: str,
) -> None:
    """List the goals of the action NAME, or of all actions: those that are active, and those that
    have ended and that the server remembers.

    With --namespace, a NAME without a slash in front is relative to the namespace.

    With --watch the list is kept up to date on a terminal; elsewhere each change is a line.
    """
    name = None if name is None else namespace.absolute(name)
    if watch and (words or limit is not None):
        raise Failure("--watch shows all goals: leave out --status and --limit", ExitCode.USAGE)
    choice = GoalChoice(words, LIMIT if limit is None else limit)
    if store is None:
        run(list_goals, url, name, namespace, choice, watch=watch, as_json=as_json)
    if watch:
        raise Failure("--store lists what is in the file now: leave out --watch", ExitCode.USAGE)
    run(list_stored, store, name, namespace, choice, as_json=as_json)


async def list_stored(
    path: str,
    name: str | None,
    namespace: Namespace,
    choice: GoalChoice = ANY,
    *,
    as_json: bool,
) -> int:
    """Print the goals in the file of a store, of one action or of those in a namespace."""
    rows = await rows_of_store(path, name)
    if name is None:
        rows = [row for row in rows if namespace.holds(row.action)]
    rows, left_out = choice.of(rows)
    _print_once(rows, name, namespace, choice, as_json=as_json)
    _tell_left_out(left_out)
    return ExitCode.SUCCEEDED


async def list_goals(
    url: str,
    name: str | None,
    namespace: Namespace = ROOT,
    choice: GoalChoice = ANY,
    *,
    watch: bool,
    as_json: bool,
) -> int:
    """Print the goals of one action, or of those in a namespace, once or until Ctrl-C.

    Raises:
        Failure: The action is not served, or the namespace has no actions.
    """
    async with connect(url) as whole:
        connection = namespace.narrow(whole) if name is None else whole
        if not watch:
            clients = await ActionClients(connection, name).now()
            found = await goals_of(clients)
            rows, left_out = choice.of(found)
            rows = await Outcomes().of(clients, rows)
            _print_once(rows, name, namespace, choice, as_json=as_json)
            _tell_left_out(left_out)
            left = {row.action for row in found if not row.info.has_worker}
            if left and not as_json:
                note_unreadable(await whole.workers(), left)
        elif as_json or not on_terminal():
            printer = EventPrinter(as_json)
            await until_interrupted(
                partial(print_events, connection, name, printer, feedback=False)
            )
        else:
            await until_interrupted(partial(_watch_screen, connection, name))
    return ExitCode.SUCCEEDED


def _tell_left_out(count: int) -> None:
    if count:
        goals = "1 more goal is" if count == 1 else f"{count:,} more goals are"
        note(f"{goals} not listed: --limit 0 lists all.")


def _print_once(
    rows: list[GoalRow],
    name: str | None,
    namespace: Namespace,
    choice: GoalChoice,
    *,
    as_json: bool,
) -> None:
    if as_json:
        family = Family(row.info for row in rows)
        for row in rows:
            say_json(row.json() | {"children": family.children(row.info.goal_id)})
    elif not rows:
        where = "" if namespace == ROOT else f" in {namespace.path}"
        of_status = " or ".join(choice.words) + " " if choice.words else ""
        note(f"There are no {of_status}goals{f' of {shown(name)}' if name else where}.")
    elif on_terminal():
        screen = console()
        for line in in_color(rows, in_columns(rows, actions=name is None, width=screen.width)):
            screen.print(line, soft_wrap=True)
    else:
        for text in in_columns(rows, actions=name is None):
            say(text)


async def _watch_screen(connection: ClientConnection, name: str | None) -> None:
    """Keep a list up to date on the terminal.

    Raises:
        ActionError: The connection is lost and is not reopened.
    """
    from rich.live import Live

    screen = console()
    actions, outcomes = ActionClients(connection, name), Outcomes()
    clients = await actions.now()
    rows, away = await goals_of(clients), ""
    to_terminal = sys.stderr.isatty()  # output to a file does not disturb the list
    with Live(console=screen, auto_refresh=False, redirect_stderr=to_terminal) as live:
        while True:
            live.update(picture(screen, rows, away, actions=name is None), refresh=True)
            await anyio.sleep(UPDATE_PAUSE)
            away = "it does not answer"
            with anyio.move_on_after(AWAY_TIMEOUT):
                try:
                    clients = await actions.now()
                    rows, away = await goals_of(clients), ""
                except ActionError as exc:
                    away = message_of(exc)
            rows = await outcomes.of(clients, rows, UPDATE_PAUSE)
            if away:
                await _check_connection(clients.values())


async def _check_connection(clients: Iterable[AnyClient]) -> None:
    """Wait for a server, at most `AWAY_TIMEOUT` seconds.

    Raises:
        ActionError: The connection is lost and is not reopened.
    """
    with anyio.move_on_after(AWAY_TIMEOUT):
        for client in clients:
            return await client.wait_for_server()  # all have the same connection
        await anyio.sleep(AWAY_TIMEOUT)

"""`fibaction goals`: list goals, once or until Ctrl-C."""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterable
from enum import Enum
from functools import partial
from typing import Any

import anyio
import click
import msgspec

from fibaction._api import ClientConnection, connect
from fibaction.border.goal_store import StoredGoal
from fibaction.cli.arguments.completion import ACTION, namespace_option
from fibaction.cli.arguments.goal_lookup import (
    DEFAULT,
    ActionClients,
    GoalChoice,
    choice_options,
    goals_of,
    with_past,
)
from fibaction.cli.arguments.names import ROOT, Namespace, shown
from fibaction.cli.arguments.options import json_option, url_option
from fibaction.cli.output.goal_details import Outcomes, with_outcome
from fibaction.cli.output.goal_table import (
    CSV_COLUMNS,
    Family,
    GoalRow,
    csv_cells,
    in_color,
    in_columns,
    picture,
)
from fibaction.cli.output.lines import console, note, on_terminal, say, say_csv, say_json
from fibaction.cli.process.exit_codes import ExitCode, Failure, message_of, run
from fibaction.cli.process.signals import until_interrupted
from fibaction.cli.verbs.actions import note_unreadable
from fibaction.cli.verbs.follow import EventPrinter, print_events
from fibaction.observe.monitor import AnyClient
from fibaction.words.errors import ActionError
from fibaction.words.goal_query import GoalQuery
from fibaction.words.goals import Outcome

UPDATE_PAUSE = 0.5
"""Seconds between two updates of a list that is watched."""
AWAY_TIMEOUT = 1.0
"""Seconds without an answer after which the server is shown as away."""
EXPORT_TIMEOUT = 30.0
"""Seconds for the results of all goals of a list for programs."""
ANY = GoalChoice()
"""All goals."""


class Form(Enum):
    """The form in which a list is printed."""

    TABLE = "table"
    JSON = "json"
    CSV = "csv"


@click.command(
    "goals",
    epilog="""\b
Examples:
  fibaction goals
  fibaction goals fibonacci --watch
  fibaction goals --status active --limit 20
  fibaction goals --since 10m --sort ran
  fibaction goals --past --since 7d --status aborted
  fibaction goals --past --label order=17
  fibaction goals drive pick --status aborted --since 2026-01-31 --csv
  fibaction goals -n /robot1 --json
  fibaction goals --past --store goals.db""",
)
@click.argument("names", metavar="[NAME]...", type=ACTION, nargs=-1)
@click.option("-w", "--watch", is_flag=True, help="Continue until Ctrl-C.")
@click.option(
    "--store",
    metavar="FILE",
    help="List the goals in the file of a store, whether its server runs or not.",
)
@choice_options
@namespace_option
@json_option
@click.option("--csv", "as_csv", is_flag=True, help="Print CSV with a heading.")
@url_option
def goals_command(
    names: tuple[str, ...],
    watch: bool,
    store: str | None,
    choice: GoalChoice,
    namespace: Namespace,
    as_json: bool,
    as_csv: bool,
    url: str,
) -> None:
    """List the goals of the actions that you name, or of all actions: the active ones, and the
    ended ones that the server remembers. With --past, the list includes the history of its store.
    With --store, no server has to run.

    With --namespace, a NAME without a slash in front is relative to the namespace.

    A time is written as 2026-01-31T12:00:00, as an age such as 30s, 10m, 2h or 7d, or in
    nanoseconds since 1970.

    With --watch the list is kept up to date on a terminal; elsewhere each change is a line.
    """
    if as_json and as_csv:
        raise Failure("--json and --csv cannot be combined")
    form = Form.JSON if as_json else Form.CSV if as_csv else Form.TABLE
    names = tuple(namespace.absolute(name) for name in names)
    if watch and store is not None:
        raise Failure("--store lists what is in the file now: leave out --watch")
    if watch:
        _check_watched(names, choice, form)
        run(watch_goals, url, *names, namespace=namespace, as_json=as_json)
    if store is not None:
        run(list_stored, store, names, namespace, choice, form=form)
    run(list_goals, url, names, namespace, choice, form=form)


def _check_watched(names: tuple[str, ...], choice: GoalChoice, form: Form) -> None:
    """Check the options beside `--watch`.

    Raises:
        Failure: They are for a list that is printed once.
    """
    if choice != DEFAULT:
        raise Failure(
            "--watch shows all goals: leave out the options that choose or sort them, such as"
            " --status and --limit"
        )
    if form is Form.CSV:
        raise Failure("--watch prints no CSV: use --json")
    if len(names) > 1:
        raise Failure("--watch shows one action, or all: give one NAME or none")


async def list_stored(
    path: str,
    names: tuple[str, ...],
    namespace: Namespace,
    choice: GoalChoice = ANY,
    *,
    form: Form = Form.TABLE,
) -> int:
    """Print the goals in the file of a store, of some actions or of those in a namespace."""
    rows = await rows_of_store(path, names, choice.wanted if choice.past else None)
    if not names:
        rows = [row for row in rows if namespace.holds(row.action)]
    rows, left_out = choice.of(rows)
    _print_rows(rows, names, namespace, choice, form)
    _tell_left_out(left_out)
    return ExitCode.SUCCEEDED


async def list_goals(
    url: str,
    names: tuple[str, ...] = (),
    namespace: Namespace = ROOT,
    choice: GoalChoice = ANY,
    *,
    form: Form = Form.TABLE,
) -> int:
    """Print the goals of some actions, or of those in a namespace.

    Raises:
        Failure: An action is not served, or the namespace has no actions.
    """
    async with connect(url) as whole:
        clients = await ActionClients(namespace.narrow(whole, *names), *names).now()
        found = await goals_of(clients)
        if choice.past:  # afterwards, so that what is forgotten meanwhile is in one of them
            found = await with_past(clients, found, choice.wanted)
        rows, left_out = choice.of(found)
        if form is Form.TABLE:
            rows = await Outcomes().of(clients, rows)
        else:
            rows = await Outcomes(len(rows)).of(clients, rows, EXPORT_TIMEOUT)
        _print_rows(rows, names, namespace, choice, form)
        _tell_left_out(left_out)
        left = {row.action for row in found if not row.info.has_worker}
        if left and form is Form.TABLE:
            note_unreadable(await whole.workers(), left)
    return ExitCode.SUCCEEDED


async def watch_goals(
    url: str, name: str | None = None, *, namespace: Namespace = ROOT, as_json: bool
) -> int:
    """Print the goals of one action, or of those in a namespace, until Ctrl-C.

    Raises:
        Failure: The action is not served, or the namespace has no actions.
    """
    async with connect(url) as whole:
        connection = namespace.narrow(whole, name)
        if as_json or not on_terminal():
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


def _print_rows(
    rows: list[GoalRow],
    names: tuple[str, ...],
    namespace: Namespace,
    choice: GoalChoice,
    form: Form,
) -> None:
    has_actions = len(names) != 1
    if form is Form.JSON:
        family = Family(row.info for row in rows)
        for row in rows:
            say_json(row.json() | {"children": family.children(row.info.goal_id)})
    elif form is Form.CSV:
        say_csv([CSV_COLUMNS, *map(csv_cells, rows)])
    elif not rows:
        where = "" if namespace == ROOT else f" in {namespace.path}"
        of_names = f" of {' or '.join(map(shown, names))}" if names else where
        note(f"There are no {choice.adjective}goals{of_names}.")
    elif on_terminal():
        screen = console()
        for line in in_color(rows, in_columns(rows, actions=has_actions, width=screen.width)):
            screen.print(line, soft_wrap=True)
    else:
        for text in in_columns(rows, actions=has_actions):
            say(text)
    unread = sum(row.outcome is None and row.info.status.is_terminal for row in rows)
    if unread and form is not Form.TABLE:
        goals = "1 goal" if unread == 1 else f"{unread:,} goals"
        note(f"The result of {goals} is left out: the server did not give it.")


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


async def rows_of_store(
    path: str, names: Collection[str], past: GoalQuery | None = None
) -> list[GoalRow]:
    """Return the goals in the file, of these actions or of all, in the order of their acceptance;
    with `past`, also those of its history that are wanted.

    Raises:
        StoreError: The file cannot be read.
    """
    from fibaction.stores._copy import stored_goals  # sqlite3 would slow down --help

    wanted = set(map(shown, names))
    rows = [
        with_outcome(GoalRow(action, goal.info), _outcome(goal))
        for action, goals in (await stored_goals(path, past)).items()
        if not wanted or shown(action) in wanted
        for goal in goals
    ]
    return sorted(rows, key=lambda row: row.info.stamp)


def _outcome(goal: StoredGoal) -> Outcome[Any] | None:
    """Return the outcome of a goal that has ended, its result as plain data."""
    if goal.told_status.is_active:
        return None
    outcome: Outcome[Any] = goal.outcome.readable(msgspec.msgpack.decode)
    return outcome

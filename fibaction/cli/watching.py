"""`fibaction goals` and `echo`: what goals there are, and what happens to them."""

from __future__ import annotations

import sys
import time
from functools import partial
from typing import TYPE_CHECKING, Any

import anyio
import click

from fibaction._api import ClientConnection, connect
from fibaction.action import Action, ActionInfo
from fibaction.cli.app import find_action, json_option, run, shown, url_option
from fibaction.cli.completing import ACTION
from fibaction.cli.ending import ExitCode, sentence_of
from fibaction.cli.escaping import clean
from fibaction.cli.goal_list import AnyClient, Clients, Row, goals_of, in_columns
from fibaction.cli.observing import (
    LOOK,
    Observer,
    follow_action,
    observe,
    still_possible,
    until_interrupted,
)
from fibaction.cli.output import console, note, on_terminal, say, say_json
from fibaction.cli.telling import INDENT, log_connection
from fibaction.cli.yaml_text import as_yaml
from fibaction.events import GoalFeedback
from fibaction.exceptions import ActionError
from fibaction.goals import GoalID, GoalInfo
from fibaction.states import GoalStatus

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

PAUSE = 0.5
"""Seconds between two looks at the goals, for a list that is watched."""
REMEMBERED = 10_000
"""Goals whose last status is known, so that none is told twice: as many as a server remembers."""

STYLES = {
    GoalStatus.ACCEPTED: "cyan",
    GoalStatus.EXECUTING: "bold green",
    GoalStatus.CANCELING: "bold yellow",
    GoalStatus.SUCCEEDED: "green",
    GoalStatus.CANCELED: "yellow",
    GoalStatus.ABORTED: "red",
}
"""How a status looks on a terminal."""


# goals


@click.command(
    "goals",
    epilog="""\b
Examples:
  fibaction goals
  fibaction goals fibonacci --watch
  fibaction goals --json""",
)
@click.argument("name", type=ACTION, required=False)
@click.option("-w", "--watch", is_flag=True, help="Go on until Ctrl-C.")
@json_option
@url_option
def goals_command(name: str | None, watch: bool, as_json: bool, url: str) -> None:
    """List the goals of the action NAME, or of all actions: the active ones, and those that have
    ended and are still known.

    With --watch the list is kept up to date on a terminal; elsewhere each change is a line.
    """
    run(goals, url, name, watch=watch, as_json=as_json)


async def goals(url: str, name: str | None, *, watch: bool, as_json: bool) -> int:
    """Print the goals, once or until Ctrl-C."""
    async with connect(url) as connection:
        if not watch:
            await _list(connection, name, as_json=as_json)
        elif as_json or not on_terminal():
            await until_interrupted(partial(_watch_lines, connection, name, as_json))
        else:
            await until_interrupted(partial(_watch_screen, connection, name))
    return ExitCode.SUCCEEDED


async def _list(connection: ClientConnection, name: str | None, *, as_json: bool) -> None:
    rows = await goals_of(await Clients(connection, name).now())
    if as_json:
        for row in rows:
            say_json(row.json())
    elif not rows:
        note(f"There are no goals{f' of {shown(name)}' if name else ''}.")
    elif on_terminal():
        screen = console()
        for line in in_color(rows, in_columns(rows, actions=name is None, width=screen.width)):
            screen.print(line, soft_wrap=True)
    else:
        for text in in_columns(rows, actions=name is None):
            say(text)


def in_color(rows: list[Row], lines: list[str]) -> list[Text]:
    """The lines of `in_columns`, for a terminal."""
    from rich.text import Text

    heading, *texts = lines
    colored = [Text(heading, "bold")]
    for row, text in zip(rows, texts, strict=True):
        status = row.info.status
        line = Text(text, "" if status.is_active else "dim")
        line.highlight_regex(rf"(?<= ){status.name}(?= )", STYLES.get(status, ""))
        colored.append(line)
    return colored


async def _watch_lines(connection: ClientConnection, name: str | None, as_json: bool) -> None:
    """Each change as a line."""
    await _observe(connection, name, _Changes(as_json), feedback=False)


async def _watch_screen(connection: ClientConnection, name: str | None) -> None:
    """A list that is kept up to date."""
    from rich.live import Live

    screen = console()
    actions = Clients(connection, name)
    clients = await actions.now()
    rows, away = await goals_of(clients), ""
    to_terminal = sys.stderr.isatty()  # what goes to a file is in nobody's way
    with Live(console=screen, auto_refresh=False, redirect_stderr=to_terminal) as live:
        while True:
            live.update(picture(screen, rows, away, actions=name is None), refresh=True)
            await anyio.sleep(PAUSE)
            away = "it does not answer"
            with anyio.move_on_after(LOOK):
                try:
                    clients = await actions.now()
                    rows, away = await goals_of(clients), ""
                except ActionError as exc:
                    away = sentence_of(exc)
            if away:
                await still_possible(clients.values())


def picture(screen: Console, rows: list[Row], away: str, *, actions: bool) -> Text:
    """The list as it fits on the screen: what is going on comes first, then what ended last."""
    from rich.text import Text

    seen = sorted(rows, key=lambda row: row.rank)[: max(screen.height - 3, 1)]
    lines = in_color(seen, in_columns(seen, actions=actions, width=screen.width - 1))
    active = sum(row.info.status.is_active for row in rows)
    state = f"{active} active, {len(rows) - active} ended"
    if len(seen) < len(rows):
        state += f"; {len(rows) - len(seen)} not shown"
    if away:
        lines.append(Text(f"The server is away: {clean(away)}", "bold red"))
    else:
        lines.append(Text(state, "dim"))
    return Text("\n", no_wrap=True, overflow="ellipsis").join(lines)


# echo


@click.command(
    "echo", epilog="\b\nExamples:\n  fibaction echo fibonacci\n  fibaction echo fibonacci --json"
)
@click.argument("name", type=ACTION)
@click.option("--full", is_flag=True, help="Show long lists and texts in full.")
@json_option
@url_option
def echo_command(name: str, full: bool, as_json: bool, url: str) -> None:
    """Show the feedback of all goals of the action NAME, and every change of their statuses, until
    Ctrl-C. It begins with the goals that are known already.
    """
    run(echo, url, name, full=full, as_json=as_json)


async def echo(url: str, name: str, *, full: bool, as_json: bool) -> int:
    """Print all that happens at an action, until Ctrl-C."""
    async with connect(url) as connection:
        told = _Echo(as_json, full=full)
        await until_interrupted(partial(_observe, connection, name, told, feedback=True))
    return ExitCode.SUCCEEDED


async def _observe(
    connection: ClientConnection, name: str | None, told: _Changes, *, feedback: bool
) -> None:
    log_connection()
    if name is None:
        await observe(connection, told, feedback=feedback)
    else:
        info = await find_action(connection, name)
        client = connection.client(Action.untyped(info))
        await follow_action(client, info, told, feedback=feedback)


class _Changes(Observer):
    """Each change of a status as a line."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self._statuses: dict[tuple[str, GoalID], GoalStatus] = {}
        self._away: set[str] = set()

    def found(self, info: ActionInfo, client: AnyClient) -> None:
        if info.name in self._away:
            self._away.remove(info.name)
            note(f"{shown(info.name)} is back")

    def told(self, action: str, event: GoalInfo | GoalFeedback[Any]) -> None:
        if isinstance(event, GoalFeedback):
            self.feedback(event)
        elif self._is_news((action, event.goal_id), event.status):
            self.status(Row(action, event))

    def gone(self, action: str, why: str) -> None:
        self._away.add(action)
        note(f"{shown(action)} is away: {why}")

    def reached(self, actions: list[ActionInfo] | None, why: str) -> None:
        pass  # what is said of each action is enough

    def status(self, row: Row) -> None:
        """A goal has another status."""
        if self._as_json:
            say_json(row.json())
        else:
            when = time.strftime("%H:%M:%S")
            cells = [when, row.goal_id, f"{_word(row.info.status):9}", clean(shown(row.action))]
            say("  ".join([*cells, row.feedback, row.client]))

    def feedback(self, event: GoalFeedback[Any]) -> None:
        """There is feedback of a goal."""

    def _is_news(self, goal: tuple[str, GoalID], status: GoalStatus) -> bool:
        # After a connection was lost, every goal is told of again.
        before = self._statuses.pop(goal, None)
        if status is GoalStatus.UNKNOWN:
            return before is not None
        self._statuses[goal] = status
        if len(self._statuses) > REMEMBERED:
            del self._statuses[next(iter(self._statuses))]
        return before is not status


class _Echo(_Changes):
    """Statuses and feedback, as much of it as is wanted."""

    def __init__(self, as_json: bool, *, full: bool) -> None:
        super().__init__(as_json)
        self._full = full

    def status(self, row: Row) -> None:
        if self._as_json:
            say_json({"event": "status", **row.json()})
        else:
            say(f"Goal {row.goal_id}: {_word(row.info.status)}\n")

    def feedback(self, event: GoalFeedback[Any]) -> None:
        goal_id, number, feedback = str(event.goal_id), event.number, event.feedback
        if self._as_json:
            say_json(
                {"event": "feedback", "goal_id": goal_id, "number": number, "feedback": feedback}
            )
        else:
            text = as_yaml(feedback, full=self._full, indent=INDENT)
            say(f"Goal {goal_id}: feedback {number}\n{text}\n")


def _word(status: GoalStatus) -> str:
    return "forgotten" if status is GoalStatus.UNKNOWN else status.name

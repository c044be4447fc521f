"""`fibaction attach` and `echo`: follow goals that were sent before."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import click

from fibaction._api import ClientConnection, connect
from fibaction.cli.arguments.completion import ACTION, GOAL_ID, namespace_option
from fibaction.cli.arguments.goal_lookup import ActionClients, find_goal, goal_digits
from fibaction.cli.arguments.names import ROOT, Namespace, find_action, shown
from fibaction.cli.arguments.options import full_option, json_option, url_option
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.goal_table import GoalRow, csv_text, iso_time
from fibaction.cli.output.lines import as_json as json_of
from fibaction.cli.output.lines import log_connection, note, on_terminal, say, say_csv, say_json
from fibaction.cli.output.render import INDENT, goal_printer, print_goal
from fibaction.cli.output.yaml_text import as_yaml
from fibaction.cli.process.exit_codes import ExitCode, Failure, message_of, run
from fibaction.cli.process.signals import until_interrupted
from fibaction.client.events import GoalFeedback
from fibaction.observe.monitor import ActionListener, AnyClient, follow_action, follow_actions
from fibaction.types.action import Action, ActionInfo, Codec
from fibaction.words.goals import GoalID, GoalInfo
from fibaction.words.plain_data import is_map
from fibaction.words.progress import ProgressMeter
from fibaction.words.statuses import GoalStatus


@click.command(
    "attach",
    epilog="""\b
Examples:
  fibaction attach 5fda41e0
  fibaction attach 5fda41e0 fibonacci --json""",
)
@click.argument("goal_id", type=GOAL_ID)
@click.argument("name", type=ACTION, required=False)
@namespace_option
@full_option
@json_option
@url_option
def attach_command(
    goal_id: str, name: str | None, namespace: Namespace, full: bool, as_json: bool, url: str
) -> None:
    """Follow a goal that was sent before: its feedback from now on, and its result. The exit code
    is that of send_goal. Ctrl-C leaves the goal running.

    The beginning of a GOAL_ID is enough if it is unique. With NAME, only the goals of that action
    are searched.
    """
    name = None if name is None else namespace.absolute(name)
    run(attach, url, goal_digits(goal_id), name, namespace, full=full, as_json=as_json)


async def attach(
    url: str,
    digits: str,
    name: str | None,
    namespace: Namespace = ROOT,
    *,
    full: bool,
    as_json: bool,
) -> int:
    """Print the events of a goal until it ends, and return the exit code.

    Raises:
        Failure, ActionError: There is no such goal, or it cannot be followed to its end.
    """
    codes = [ExitCode.INTERRUPTED]
    async with connect(url) as connection:
        clients = await ActionClients(namespace.narrow(connection, name), name).now()
        action, goal_id = await find_goal(clients, digits)
        if await until_interrupted(
            partial(_attach, clients[action], goal_id, codes, full, as_json)
        ):
            note(f"The goal {goal_id} was left as it is.")
    return codes[-1]


async def _attach(
    client: AnyClient, goal_id: GoalID, codes: list[ExitCode], full: bool, as_json: bool
) -> None:
    stream = await client.endpoint.feedback(goal_id)
    printer = goal_printer(feedback=True, as_json=as_json, full=full)
    printer.accepted(goal_id, stream.stamp, stream.info.parent)
    codes.append(await print_goal(stream, client.action, printer, live=not full))
    if stream.checkpoint is not None:
        checkpoints: Codec[Any] = Codec(object, f"the checkpoint of goal {goal_id}")
        printer.given_up(checkpoints.decode(stream.checkpoint) if stream.checkpoint else None)


REMEMBERED = 10_000
"""Goals whose last status is remembered, so that none is printed twice: as many as a server has."""


@click.command(
    "echo", epilog="\b\nExamples:\n  fibaction echo fibonacci\n  fibaction echo fibonacci --json"
)
@click.argument("name", type=ACTION)
@namespace_option
@full_option
@json_option
@click.option("--csv", "as_csv", is_flag=True, help="Print the feedback as CSV with a heading.")
@url_option
def echo_command(
    name: str, namespace: Namespace, full: bool, as_json: bool, as_csv: bool, url: str
) -> None:
    """Print the feedback of all goals of the action NAME, and every change of their statuses, until
    Ctrl-C. The statuses of the goals that the server knows come first.
    """
    if as_json and as_csv:
        raise Failure("--json and --csv cannot be combined")
    printer = CsvPrinter() if as_csv else EchoPrinter(as_json, full=full)
    run(echo, url, namespace.absolute(name), printer)


async def echo(url: str, name: str, printer: EventPrinter) -> int:
    """Print all events of an action, until Ctrl-C."""
    async with connect(url) as connection:
        await until_interrupted(partial(print_events, connection, name, printer, feedback=True))
    return ExitCode.SUCCEEDED


async def print_events(
    connection: ClientConnection, name: str | None, printer: EventPrinter, *, feedback: bool
) -> None:
    """Print the events of one action, or of all, until canceled.

    Raises:
        Failure: The action is not served.
        ActionError: The connection is lost and is not reopened.
    """
    log_connection()
    if name is None:
        await follow_actions(connection, printer, feedback=feedback)
    else:
        info = await find_action(connection, name)
        client = connection.client(Action.untyped(info))
        await follow_action(client, info, printer, feedback=feedback)


class EventPrinter(ActionListener):
    """Prints each change of a status as a line."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self._statuses: dict[tuple[str, GoalID], GoalStatus] = {}
        self._away: set[str] = set()

    def on_action_found(self, info: ActionInfo, client: AnyClient) -> None:
        if info.name in self._away:
            self._away.remove(info.name)
            note(f"{shown(info.name)} is back")

    def on_event(self, action: str, event: GoalInfo | GoalFeedback[Any]) -> None:
        if isinstance(event, GoalFeedback):
            self.print_feedback(event)
        elif self._is_news((action, event.goal_id), event.status):
            self.print_status(GoalRow(action, event))

    def on_action_lost(self, action: str, reason: str) -> None:
        self._away.add(action)
        note(f"{shown(action)} is away: {message_of(reason)}")

    def on_actions(self, actions: list[ActionInfo] | None, reason: str) -> None:
        pass  # each action is reported by itself

    def print_status(self, row: GoalRow) -> None:
        """Print a goal that has another status."""
        if self._as_json:
            say_json(row.json())
        else:
            when = time.strftime("%H:%M:%S")
            cells = [when, row.goal_id, f"{_word(row.info.status):9}", excerpt(shown(row.action))]
            say("  ".join([*cells, row.feedback, row.client]))

    def print_feedback(self, event: GoalFeedback[Any]) -> None:
        """Print feedback of a goal; here it is left out."""

    def _is_news(self, goal: tuple[str, GoalID], status: GoalStatus) -> bool:
        # After a connection was lost, the statuses of all goals come again.
        before = self._statuses.pop(goal, None)
        if status is GoalStatus.UNKNOWN:
            return before is not None
        self._statuses[goal] = status
        if len(self._statuses) > REMEMBERED:
            del self._statuses[next(iter(self._statuses))]
        return before is not status


class EchoPrinter(EventPrinter):
    """Prints statuses and feedback.

    On a terminal, feedback that tells the progress of its goal has a bar, unless all is wanted.
    """

    def __init__(self, as_json: bool, *, full: bool) -> None:
        super().__init__(as_json)
        self._full = full
        self._has_bars = not as_json and not full and on_terminal()
        self._meters: dict[GoalID, ProgressMeter] = {}

    def print_status(self, row: GoalRow) -> None:
        if self._as_json:
            say_json({"event": "status", **row.json()})
        else:
            say(f"Goal {row.goal_id}: {_word(row.info.status)}\n")

    def print_feedback(self, event: GoalFeedback[Any]) -> None:
        goal_id, number, feedback = str(event.goal_id), event.number, event.feedback
        if self._as_json:
            facts = {"goal_id": goal_id, "number": number, "at": event.at}
            say_json({"event": "feedback", **facts, "feedback": feedback})
            return
        head = f"Goal {goal_id}: feedback {number}"
        text = as_yaml(feedback, full=self._full, indent=INDENT)
        progress = self._meter(event.goal_id).read(feedback) if self._has_bars else None
        if progress is None or progress.fraction is None:
            say(f"{head}\n{text}\n")
            return
        from fibaction.cli.output.progress import say_with_bar

        say_with_bar(head, progress.fraction, text)

    def _meter(self, goal_id: GoalID) -> ProgressMeter:
        """Return the reader of a goal's progress; that of the goal longest silent is forgotten."""
        meter = self._meters.pop(goal_id, None) or ProgressMeter()
        self._meters[goal_id] = meter
        if len(self._meters) > REMEMBERED:
            del self._meters[next(iter(self._meters))]
        return meter


class CsvPrinter(EventPrinter):
    """Prints each feedback as a row, with its time and a column for each field; no statuses."""

    def __init__(self) -> None:
        super().__init__(as_json=False)
        self._fields: tuple[str, ...] | None = None

    def on_action_found(self, info: ActionInfo, client: AnyClient) -> None:
        super().on_action_found(info, client)
        if self._fields is None:
            from fibaction.schema.template import Template  # its imports would slow down --help

            self._fields = tuple(Template(info.feedback).fields)
            names = map(csv_text, self._fields or ("feedback",))
            say_csv([("time", "goal_id", "attempt", "number", *names)])

    def print_status(self, row: GoalRow) -> None:
        pass  # a row of CSV has one form

    def print_feedback(self, event: GoalFeedback[Any]) -> None:
        facts = (iso_time(event.at), str(event.goal_id), str(event.attempt), str(event.number))
        value = event.feedback
        values = [value]
        if self._fields:
            values = [value.get(name) if is_map(value) else None for name in self._fields]
        say_csv([[*facts, *map(_cell, values)]])


def _cell(value: object) -> str:
    """Return a value for a cell: text as it is, others in JSON, nothing for None."""
    if isinstance(value, str):
        return csv_text(value)
    return "" if value is None else json_of(value)


def _word(status: GoalStatus) -> str:
    return "forgotten" if status is GoalStatus.UNKNOWN else status.name

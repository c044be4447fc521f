"""`fibaction list`, `find`, `info`, `type` and `workers`: describe what is served."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from itertools import groupby
from types import MappingProxyType
from urllib.parse import urlsplit

import click
import msgspec

from fibaction._api import ClientConnection, connect
from fibaction.border.endpoints import Endpoint
from fibaction.border.urls import without_settings
from fibaction.cli.arguments.completion import ACTION, TYPE, namespace_option
from fibaction.cli.arguments.goal_text import GoalTemplate
from fibaction.cli.arguments.names import (
    ROOT,
    Namespace,
    find_action,
    is_type,
    namespace_of,
    no_action,
    shown,
)
from fibaction.cli.arguments.options import json_option, url_option
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.goal_table import aligned, duration
from fibaction.cli.output.lines import note, say, say_json
from fibaction.cli.process.exit_codes import ExitCode, Failure, run
from fibaction.feeds.answers import intakes_of
from fibaction.types.action import Action, ActionInfo
from fibaction.words.errors import ActionError, ServerNotFound
from fibaction.words.goals import WorkerInfo
from fibaction.words.intake import Intake

types_option = click.option("-t", "--show-types", is_flag=True, help="Show the types, too.")
count_option = click.option(
    "-c", "--count", "--count-actions", "count", is_flag=True, help="Show only the number."
)


@click.command(
    "list",
    epilog="""\b
Examples:
  fibaction list -t
  fibaction list -n /robot1
  fibaction list --group""",
)
@types_option
@count_option
@namespace_option
@click.option("-g", "--group", is_flag=True, help="Show each namespace, and its actions below it.")
@json_option
@url_option
def list_command(
    show_types: bool, count: bool, namespace: Namespace, group: bool, as_json: bool, url: str
) -> None:
    """List the actions that are served."""
    settings = {"show_types": show_types, "count": count, "as_json": as_json}
    run(list_actions, url, namespace, group=group, **settings)


async def list_actions(
    url: str,
    namespace: Namespace = ROOT,
    *,
    group: bool = False,
    show_types: bool,
    count: bool,
    as_json: bool,
) -> int:
    """Print the names of the actions, one a line, or their number.

    Raises:
        Failure: The namespace has no actions.
    """
    async with connect(url) as connection:
        actions = await namespace.narrow(connection).actions()
        intakes = {} if count else await intakes_at(connection, actions)
    if group:
        print_groups(actions, show_types=show_types, count=count, as_json=as_json)
    else:
        print_actions(actions, show_types=show_types, count=count, as_json=as_json, intakes=intakes)
    for name in sorted(intakes, key=shown) if not as_json else ():
        if text := intakes[name].text:
            note(f"{shown(name)}: {text}")
    return ExitCode.SUCCEEDED


async def intakes_at(
    connection: ClientConnection, actions: Collection[ActionInfo]
) -> dict[str, Intake]:
    """Return how actions take goals, as far as their servers tell it in time."""
    endpoints: list[Endpoint] = []
    for info in actions:
        with suppress(ActionError):  # its type is not known here
            endpoints.append(connection.client(Action.untyped(info)).endpoint)
    return await intakes_of(endpoints)


@click.command("find", epilog="\b\nExample:\n  fibaction find arduinobot_msgs/action/Fibonacci")
@click.argument("type_name", metavar="TYPE", type=TYPE)
@count_option
@json_option
@url_option
def find_command(type_name: str, count: bool, as_json: bool, url: str) -> None:
    """List the actions of the type TYPE, written as package/action/Type."""
    run(find, url, type_name, count=count, as_json=as_json)


async def find(url: str, type_name: str, *, count: bool, as_json: bool) -> int:
    """Print the names of the actions of a type, one a line, or their number."""
    async with connect(url) as connection:
        actions = await connection.actions()
    found = [info for info in actions if is_type(type_name, info.type_name)]
    print_actions(found, show_types=False, count=count, as_json=as_json)
    return ExitCode.SUCCEEDED


def print_actions(
    actions: Collection[ActionInfo],
    *,
    show_types: bool,
    count: bool,
    as_json: bool,
    intakes: Mapping[str, Intake] = MappingProxyType({}),
) -> None:
    """Print the actions in the order of their names, or their number."""
    if count:
        number = len(actions)
        say_json({"count": number}) if as_json else say(str(number))
        return
    for info in sorted(actions, key=lambda info: shown(info.name)):
        if as_json:
            say_json(_json(info) | intake_json(intakes.get(info.name)))
        else:
            say(with_type(shown(info.name), info.type_name if show_types else ""))


def print_groups(
    actions: Collection[ActionInfo], *, show_types: bool, count: bool, as_json: bool
) -> None:
    """Print each namespace, and below it its actions, or behind it their number."""

    def key(info: ActionInfo) -> tuple[str, str]:
        return namespace_of(info.name), shown(info.name)

    for namespace, group in groupby(sorted(actions, key=key), key=lambda info: key(info)[0]):
        infos = list(group)
        if as_json:
            for value in [{"count": len(infos)}] if count else map(_json, infos):
                say_json({"namespace": namespace, **value})
            continue
        say(f"{excerpt(namespace)}{f': {len(infos)}' if count else ''}")
        for info in () if count else infos:
            name = shown(info.name).rpartition("/")[2]
            say(f"    {with_type(name, info.type_name if show_types else '')}")


def intake_json(intake: Intake | None) -> dict[str, object]:
    """Return how an action takes goals, if that is not as usual, and its schedule, for programs."""
    if intake is None:
        return {}
    told: dict[str, object] = {"intake": intake.mode.value} if intake.text else {}
    if intake.schedule is not None:
        told["schedule"] = msgspec.to_builtins(intake.schedule)
    return told


def _json(info: ActionInfo) -> dict[str, object]:
    return {"name": info.name, "type": info.type_name}


def with_type(name: str, type_name: str) -> str:
    """Return a name with its type in brackets, if there is one."""
    return f"{excerpt(name)} [{excerpt(type_name)}]" if type_name else excerpt(name)


LONGEST_TEXT = 20
"""Lines of the description of an action."""


@click.command("info", epilog="\b\nExample:\n  fibaction info fibonacci")
@click.argument("name", type=ACTION)
@types_option
@count_option
@namespace_option
@json_option
@url_option
def info_command(
    name: str, show_types: bool, count: bool, namespace: Namespace, as_json: bool, url: str
) -> None:
    """Show what the action NAME does, its servers and its clients, and its goal as a template to
    fill in. With --json, also the JSON Schemas of its goal, feedback and result.
    """
    options = {"show_types": show_types, "count": count, "as_json": as_json}
    run(print_info, url, namespace.absolute(name), **options)


async def print_info(url: str, name: str, *, show_types: bool, count: bool, as_json: bool) -> int:
    """Print the clients and the servers of an action.

    Raises:
        Failure: It has neither.
    """
    async with connect(url) as connection:
        actions = await connection.actions()
        found = [info for info in actions if shown(info.name) == shown(name)]
        info = found[0] if found else ActionInfo(name)
        try:
            peers = await connection.peers(info.name)
        except (ServerNotFound, UnicodeError) as exc:  # a name that is not text has no server
            raise no_action(name, actions) from exc
        intake = (await intakes_at(connection, found)).get(info.name)
        release = connection.release
    if not (found or peers.servers or peers.clients):
        raise no_action(name, actions)
    if as_json:
        schemas: dict[str, object] = {
            "goal": info.goal,
            "feedback": info.feedback,
            "result": info.result,
            "template": GoalTemplate(info.goal).goal,
            "description": info.description,
            "version": release,
        }
        names = {"clients": peers.clients, "servers": peers.servers}
        more = {} if count else schemas | intake_json(intake)
        say_json({"name": info.name, "type": info.type_name, **names, **more})
        return ExitCode.SUCCEEDED
    say(f"Action: {excerpt(shown(info.name))}")
    for line in () if count else info.description.splitlines()[:LONGEST_TEXT]:
        say(f"    {excerpt(line)}".rstrip())
    for role, peer_names in (("clients", peers.clients), ("servers", peers.servers)):
        say(f"Action {role}: {len(peer_names)}")
        for one in () if count else peer_names:
            say(f"    {with_type(one, info.type_name if show_types else '')}")
    if release and not count:
        say(f"Version of fibaction: {excerpt(release)}")
    if intake is not None and not count:
        if intake.schedule is not None:
            say(f"Schedule: {intake.schedule.text}")
        if intake.text:
            say(f"Intake: {intake.text}")
    if info.goal and not count:
        say("Goal:")
        for line in GoalTemplate(info.goal).lines():
            say(f"    {line}")
    return ExitCode.SUCCEEDED


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


FLEETS = ("nats", "nats+tls")
"""The schemes of the URLs of fleets."""


@click.command("workers", epilog="\b\nExample:\n  fibaction workers -u nats://127.0.0.1/robots")
@json_option
@url_option
def workers_command(as_json: bool, url: str) -> None:
    """List the workers of a fleet: their goals, whether they take new ones, the time since they
    joined, and their actions.
    """
    run(list_workers, url, as_json=as_json)


async def list_workers(url: str, *, as_json: bool) -> int:
    """Print the workers, one a line.

    Raises:
        Failure: The URL is not that of a fleet.
    """
    if urlsplit(url).scheme not in FLEETS:
        raise Failure(
            f"{without_settings(url)} is one server, and not a fleet with workers: give the URL of"
            f" a fleet, such as nats://127.0.0.1/robots"
        )
    async with connect(url) as connection:
        workers = await connection.workers()
    if as_json:
        for worker in workers:
            say_json(msgspec.to_builtins(worker))
    elif not workers:
        note(f"There are no workers at {without_settings(url)}.")
    else:
        for line in lines_of(workers, time.time()):
            say(line)
        note_unreadable(workers)
    return ExitCode.SUCCEEDED


def note_unreadable(workers: Sequence[WorkerInfo], actions: Collection[str] = ()) -> None:
    """Print how many goals of each action no worker can read; of some actions, if there are any."""
    for name in sorted({name for worker in workers for name in worker.unreadable}):
        serving = [worker for worker in workers if name in worker.actions]
        count = min(worker.unreadable.get(name, 0) for worker in serving)
        if count and (name in actions or not actions):
            goals = "1 waiting goal" if count == 1 else f"{count:,} waiting goals"
            note(
                f"{goals} of {shown(name)} that no worker here can read: start a worker of the"
                f" version that accepted them, or end them with unreadable='abort'"
            )


def lines_of(workers: Sequence[WorkerInfo], now: float) -> list[str]:
    """Return the workers in columns, below a line of headings."""
    heading = ["WORKER", "ROOM", "GOALS", "JOINED", "ACTIONS"]
    return aligned([heading, *(_cells(worker, now) for worker in workers)])


def _cells(worker: WorkerInfo, now: float) -> list[str]:
    return [
        excerpt(worker.name),
        "yes" if worker.has_room else "no",
        str(worker.goals),
        f"{duration(now - worker.since / 1e9)} ago",
        ", ".join(excerpt(name) for name in sorted(map(shown, worker.actions))) or "-",
    ]

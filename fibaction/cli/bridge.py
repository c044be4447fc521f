"""`fibaction bridge`: serve at one URL the actions of another, by `fibaction.serve`."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from contextlib import suppress

import anyio
import click

from fibaction._api import connect, serve
from fibaction.abc import Connection, Endpoint
from fibaction.action import ActionInfo
from fibaction.cli.action_names import names_of, no_action, shown
from fibaction.cli.completion import ACTION
from fibaction.cli.exit_codes import ExitCode, Failure, advising, message_of, run
from fibaction.cli.logs import log_events, log_with_time
from fibaction.cli.namespace_option import namespace_option
from fibaction.cli.namespaces import ROOT, Namespace
from fibaction.cli.options import reject_inproc
from fibaction.cli.output import note, say
from fibaction.cli.signals import stop_signals
from fibaction.exceptions import ServerNotFound, TransportError
from fibaction.urls import without_settings

LOOK_PAUSE = 0.2
"""Seconds between two looks for an action that a bridge waits for."""


@click.command(
    "bridge",
    epilog="""\b
Examples:
  fibaction bridge ros2:// tcp://127.0.0.1:7400
  fibaction bridge tcp://127.0.0.1:7400 ros2:// fibonacci
  fibaction bridge ros2:// tcp://127.0.0.1:7400 -n /robot1""",
)
@click.argument("from_url", metavar="FROM_URL")
@click.argument("to_url", metavar="TO_URL")
@click.argument("names", metavar="[NAME]...", nargs=-1, type=ACTION)
@namespace_option
def bridge_command(
    from_url: str, to_url: str, names: tuple[str, ...], namespace: Namespace
) -> None:
    """Serve at TO_URL the actions that are served at FROM_URL.

    Without a NAME, the bridge serves all actions that there are when it starts, or all of those in
    a namespace. It waits for an action that is named. If the server is away for a while, the bridge
    continues when it is back.

    With --namespace, a NAME without a slash in front is relative to the namespace.

    Ctrl-C or SIGTERM ends the bridge; the goals go on at their server. A second one ends at once.
    """
    if from_url == to_url:
        raise Failure("FROM_URL and TO_URL are the same: a bridge needs two", ExitCode.USAGE)
    reject_inproc(from_url)
    reject_inproc(to_url)
    with log_with_time():
        full_names = list(map(namespace.absolute, names))
        run(bridge, from_url, to_url, full_names, namespace, uvloop=True)


async def bridge(
    from_url: str, to_url: str, names: Sequence[str], namespace: Namespace = ROOT
) -> int:
    """Serve at one URL actions of another, until a signal comes.

    They are those that are named, or else all in the namespace.

    Raises:
        Failure: There is no action to serve, and none to wait for is named.
    """
    async with stop_signals() as stop, connect(from_url) as connection:
        there_now = namespace.narrow(connection)
        infos = await (_wait_for(names, connection, stop) if names else _all_at(there_now))
        if stop.is_set():
            return ExitCode.SUCCEEDED
        endpoints = list(_endpoints(connection, infos, choose=not names))
        if not endpoints:
            text = f"there is no action to bridge at {without_settings(from_url)}"
            raise Failure(text, ExitCode.UNREACHABLE)
        async with serve(endpoints, to_url) as (where,):
            log_events()
            there = without_settings(from_url)
            say(f"bridging {names_of(endpoints)} from {there} to {where}, Ctrl-C stops it")
            await stop.wait()
    return ExitCode.SUCCEEDED


async def _all_at(connection: Connection) -> list[ActionInfo]:
    """Return all actions that there are now.

    Raises:
        Failure: There is no server.
    """
    with advising("or name the actions to wait for"):
        return await connection.actions()


async def _wait_for(
    names: Sequence[str], connection: Connection, stop: anyio.Event
) -> list[ActionInfo]:
    """Wait until all named actions are served, and return them; none if it is stopped before."""
    told = False
    while not stop.is_set():
        infos: list[ActionInfo] = []
        with suppress(ServerNotFound):
            infos = await connection.actions()
        known = {shown(info.name): info for info in infos}
        missing = [name for name in names if shown(name) not in known]
        if not missing:
            return list({shown(name): known[shown(name)] for name in names}.values())
        if not told:
            text = f"waiting for {', '.join(map(shown, missing))}"
            note(f"{no_action(missing[0], infos).message}: {text}" if infos else text)
            told = True
        with anyio.move_on_after(LOOK_PAUSE):
            await stop.wait()
    return []


def _endpoints(
    connection: Connection, infos: Iterable[ActionInfo], *, choose: bool
) -> Generator[Endpoint, None, None]:
    """Yield the endpoints of actions; with `choose` without those that cannot be used here.

    Raises:
        TransportError: One cannot be used: its ROS type is not installed.
    """
    for info in infos:
        try:
            yield connection.endpoint(info)
        except TransportError as exc:
            if not choose:
                raise
            note(f"{shown(info.name)} is left out: {message_of(exc)}")

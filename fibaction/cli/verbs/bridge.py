"""`fibaction bridge`: serve at one URL the actions of another, by `fibaction.serve`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress

import anyio
import click

from fibaction._api import ClientConnection, connect, serve
from fibaction.border.abc import Connection, Endpoint
from fibaction.border.event_loop import Background
from fibaction.border.urls import transport_for, without_settings
from fibaction.cli.arguments.completion import ACTION, NAMESPACE, namespace_option
from fibaction.cli.arguments.names import ROOT, Namespace, names_of, no_action, shown
from fibaction.cli.arguments.options import reject_inproc
from fibaction.cli.bridge.ends import open_end
from fibaction.cli.bridge.renames import AS_THEY_ARE, Renames
from fibaction.cli.bridge.sources import BridgedActions, BridgedSources, named_urls
from fibaction.cli.output.lines import log_events, log_with_time, note, say
from fibaction.cli.process.exit_codes import ExitCode, Failure, advising, run
from fibaction.cli.process.signals import stop_signals
from fibaction.types.action import ActionInfo
from fibaction.words.errors import ServerNotFound

LOOK_PAUSE = 0.2
"""Seconds between two looks for an action that a bridge waits for."""


@click.command(
    "bridge",
    epilog="""\b
Examples:
  fibaction bridge ros2:// tcp://127.0.0.1:7400
  fibaction bridge tcp://127.0.0.1:7400 ros2:// fibonacci
  fibaction bridge ros2:// tcp://127.0.0.1:7400 -n /robot1
  fibaction bridge tcp://robot1:7400 ros2:// --into /robot1
  fibaction bridge ros2:// tcp://127.0.0.1:7400 pick --rename pick=grasp
  fibaction bridge arm=dds:// base=zenoh:// tcp://127.0.0.1:7400""",
)
@click.argument("from_url", metavar="[NAME=]FROM_URL...")
@click.argument("to_url", metavar="TO_URL")
@click.argument("names", metavar="[NAME]...", nargs=-1, type=ACTION)
@namespace_option
@click.option(
    "--into",
    metavar="NAMESPACE",
    type=NAMESPACE,
    help="Serve the actions in this namespace, in place of that of --namespace.",
)
@click.option(
    "--rename",
    "rules",
    metavar="OLD=NEW",
    multiple=True,
    help="Serve the action OLD under the name NEW. Can be given several times.",
)
def bridge_command(
    from_url: str,
    to_url: str,
    names: tuple[str, ...],
    namespace: Namespace,
    into: Namespace | None,
    rules: tuple[str, ...],
) -> None:
    """Serve at TO_URL the actions that are served at FROM_URL.

    Without a NAME, the bridge serves all actions, or all of those in a namespace. It adds actions
    that come later, and removes those that leave. With NAMEs it serves these actions, and waits for
    them first. If the server is away for a while, the bridge continues when it is back.

    With --namespace, a NAME or OLD without a slash in front is relative to the namespace, and with
    --into, NEW is relative to that one.

    The actions of several FROM_URLs are each in a namespace, which is the NAME before the URL, or
    else its host or its scheme. Those that are not there are tried again.

    Ctrl-C or SIGTERM ends the bridge; the goals continue at their server. A second one ends it at
    once.
    """
    more = [name for name in names if "://" in name]
    names = tuple(name for name in names if name not in more)
    urls = [from_url, to_url, *more]
    to_url = urls.pop()
    sources = named_urls(urls)
    if to_url in sources.values():
        raise Failure("FROM_URL and TO_URL are the same: a bridge needs two")
    reject_inproc(to_url)
    if more:
        if names or rules or into or namespace != ROOT:
            raise Failure("names, and options for them, are for a bridge with one FROM_URL")
        with log_with_time():
            run(bridge_several, sources, to_url, uvloop=True)
    ((name, from_url),) = sources.items()
    into = into or (Namespace.parse(name) if name else None)
    renames = Renames.parse(rules, namespace, into)
    full_names = list(map(namespace.absolute, names))
    if full_names:
        _check_names(full_names, renames)
    with log_with_time():
        run(bridge, from_url, to_url, full_names, renames, uvloop=True)


def _check_names(names: Sequence[str], renames: Renames) -> None:
    """Check the rules for actions that are named.

    Raises:
        Failure: A rule is about another action, or two actions get the same name.
    """
    if old := renames.unknown(names):
        text = f"the action {old} is renamed, and is not among those to bridge: name it as well"
        raise Failure(text)
    renames.check(dict.fromkeys(map(shown, names)))


async def bridge(
    from_url: str, to_url: str, names: Sequence[str], renames: Renames = AS_THEY_ARE
) -> int:
    """Serve at one URL actions of another, until a signal comes.

    They are those that are named, or else all in the namespace from which `renames` takes them.

    Raises:
        Failure: There is no action to serve, and none to wait for is named; or a rule is about an
            action that is not there, or gives two actions the same name.
        TransportError: One of the URLs cannot be used.
    """
    transport_for(to_url)  # an error of this URL comes before anything is waited for
    async with stop_signals() as stop, connect(from_url) as connection:
        if names:
            await _bridge_named(connection, from_url, to_url, names, renames, stop)
        else:
            await _bridge_all(connection, from_url, to_url, renames, stop)
    return ExitCode.SUCCEEDED


async def bridge_several(urls: dict[str, str], to_url: str) -> int:
    """Serve at one URL the actions of several, by their names, until a signal comes.

    Raises:
        Failure: Actions cannot come and go at this URL.
        TransportError: It cannot be used.
    """
    sources, to = BridgedSources(urls), without_settings(to_url)
    async with stop_signals() as stop, sources.served_at(to_url) as end:
        if not end.can_change:
            raise Failure(f"the actions at {to} stay the same, so a bridge to it has one FROM_URL")
        say(f"bridging from {sources} to {end.where or to}, Ctrl-C stops it")
        await stop.wait()
    return ExitCode.SUCCEEDED


async def _bridge_named(
    connection: Connection,
    from_url: str,
    to_url: str,
    names: Sequence[str],
    renames: Renames,
    stop: anyio.Event,
) -> None:
    infos = await _wait_for(names, connection, stop)
    if stop.is_set():
        return
    endpoints = [renames.endpoint(connection.endpoint(info)) for info in infos]
    async with serve(endpoints, to_url) as (where,):
        _say_bridging(endpoints, from_url, where)
        await stop.wait()


async def _bridge_all(
    connection: ClientConnection, from_url: str, to_url: str, renames: Renames, stop: anyio.Event
) -> None:
    there_now = renames.source.narrow(connection)
    infos = await _all_at(there_now)
    if stop.is_set():
        return
    if infos and (old := renames.unknown(info.name for info in infos)):
        raise no_action(old, infos)
    renames.check(info.name for info in infos)
    nothing = Failure(
        f"there is no action to bridge at {without_settings(from_url)}", ExitCode.UNREACHABLE
    )
    if not infos:
        raise nothing
    async with open_end(to_url) as end, Background() as tasks:
        bridged = BridgedActions(there_now, renames, end)
        await bridged.take(infos)
        if not bridged.endpoints:
            raise nothing
        await end.begin()
        _say_bridging(bridged.endpoints, from_url, end.where)
        if end.can_change:
            tasks.start_soon(bridged.follow)
        await stop.wait()


def _say_bridging(endpoints: Iterable[Endpoint], from_url: str, where: str) -> None:
    log_events()
    there = without_settings(from_url)
    say(f"bridging {names_of(endpoints)} from {there} to {where}, Ctrl-C stops it")


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

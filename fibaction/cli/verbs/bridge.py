"""`fibaction bridge` and `console`: serve what is found at one URL at another one, or as a page.

The console operates the actions of any server, on this machine only, or shows a recording. Its page
is part of every web server of this library. So this verb serves what it has connected to once more,
at an `http://` address of this machine, and opens that. Actions that come later are served as soon
as they are found. The address has a new token each time, in its fragment, which a browser does not
send or log.
"""

from __future__ import annotations

import os
import secrets
import sys
import webbrowser
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

import anyio
import click
from anyio import to_thread

from fibaction._api import ClientConnection, connect, serve
from fibaction.border.abc import Connection, Endpoint, Transport
from fibaction.border.event_loop import Background
from fibaction.border.urls import transport_for, without_settings
from fibaction.cli.arguments.completion import ACTION, NAMESPACE, namespace_option
from fibaction.cli.arguments.names import ROOT, Namespace, names_of, no_action, shown
from fibaction.cli.arguments.options import reject_inproc, url_of
from fibaction.cli.bridge.ends import AS_THEY_ARE, Renames, open_end
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


@click.command(
    "console",
    epilog="""\b
Examples:
  fibaction console tcp://192.168.0.7:7400
  fibaction console ros2:// --port 8080
  fibaction console nats://127.0.0.1:4222/fleet --no-open
  fibaction console arm=tcp://10.0.0.7:7400 nats://10.0.0.2/fleet dds://
  fibaction console today.jsonl""",
)
@click.argument("sources", metavar="[[NAME=]URL]...|[FILE]", nargs=-1)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    show_default=True,
    help="Port of the page on this machine; 0 is a free one.",
)
@click.option("--no-open", is_flag=True, help="Print the address, and open no browser.")
@click.pass_context
def console_command(
    context: click.Context, sources: tuple[str, ...], port: int, no_open: bool
) -> None:
    """Open a page in the browser to watch and operate the actions of servers, or to look at a
    recording of `fibaction serve --record` or `fibaction record`.

    The actions of several servers are each in a namespace, which is the NAME of the server, or else
    its host or its scheme. Those that are not there are tried again.

    The page is served on this machine only, with a token of its own in the address.

    Ctrl-C or SIGTERM ends it; the goals continue at their server. A second one ends it at once.
    """
    given = sources or (url_of(context),)
    opens = not no_open and can_open(os.environ, sys.platform)
    with log_with_time():
        if len(given) == 1 and "://" not in given[0]:
            check_is_recording(given[0])
            run(show_recording, given[0], port, opens=opens)
        else:
            run(console, named_urls(given), port, opens=opens)


def check_is_recording(path: str) -> None:
    """Raise `Failure` if a file is not a recording that has begun."""
    from fibaction.observe.recordings.recording_file import read_records

    try:
        record = next(read_records(path), None)
    except OSError as exc:
        advice = "name a file, or a URL as in tcp://127.0.0.1:7400"
        raise Failure(f"{path} cannot be read: {exc.strerror}; {advice}") from exc
    if record is None:
        raise Failure(f"{path} is not a recording of fibaction, or is empty")


def can_open(environment: Mapping[str, str], platform: str) -> bool:
    """Return whether a browser with a window can be opened from here."""
    if not platform.startswith("linux"):
        return True
    return any(name in environment for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))


async def console(urls: dict[str, str], port: int, *, opens: bool) -> int:
    """Serve the actions of servers, by their names, with the console, until a signal comes.

    Raises:
        TransportError: The only server is not there. Of several, those that come later are served
            then.
    """
    sources = BridgedSources(urls)
    page, token = page_at(port, sources=sources)
    async with stop_signals() as stop, sources.served_at(page) as end:
        await show_page(str(sources), f"{end.where}/#token={token}", stop, opens=opens)
    return ExitCode.SUCCEEDED


async def show_recording(path: str, port: int, *, opens: bool) -> int:
    """Serve a recording with the console, until a signal comes."""
    page, token = page_at(port, recording=path)
    async with stop_signals() as stop, open_end(page) as end:
        where = f"{end.where}/?recording={quote(Path(path).name)}#token={token}"
        await show_page(path, where, stop, opens=opens)
    return ExitCode.SUCCEEDED


async def show_page(what: str, address: str, stop: anyio.Event, *, opens: bool) -> None:
    """Tell the address of the page, and open it if that is wanted, until the event is set."""
    say(f"console of {what} at {address} , Ctrl-C stops it")
    async with Background() as tasks:
        if opens:
            tasks.start_soon(open_page, address)
        await stop.wait()


def page_at(port: int, **settings: Any) -> tuple[Transport, str]:
    """Return the server of the page at a port of this machine, and its token."""
    token = secrets.token_urlsafe(16)
    url = f"http://127.0.0.1:{port}"
    return transport_for(url, tokens={token: "console"}, **settings), token


async def open_page(address: str) -> None:
    """Open an address in the browser, in a thread: some take their time to come back."""
    await to_thread.run_sync(webbrowser.open, address, abandon_on_cancel=True)

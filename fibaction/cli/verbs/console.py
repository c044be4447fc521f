"""`fibaction console`: the page to operate the actions of any server, on this machine only; or to
look at a recording.

The page is part of every web server of this library. So this verb serves what it has connected to
once more, at an `http://` address of this machine, and opens that. Actions that come later are
served as soon as they are found. The address has a new token each time, in its fragment, which a
browser does not send or log.
"""

from __future__ import annotations

import os
import secrets
import sys
import webbrowser
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import anyio
import click
from anyio import to_thread

from fibaction.border.abc import Transport
from fibaction.border.event_loop import Background
from fibaction.border.urls import transport_for
from fibaction.cli.arguments.options import url_of
from fibaction.cli.bridge.ends import open_end
from fibaction.cli.bridge.sources import BridgedSources, named_urls
from fibaction.cli.output.lines import log_with_time, say
from fibaction.cli.process.exit_codes import ExitCode, Failure, run
from fibaction.cli.process.signals import stop_signals


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

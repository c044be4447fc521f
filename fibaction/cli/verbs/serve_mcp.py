"""`fibaction mcp`: the actions of servers as tools of language models, with the extra `mcp`.

It is not called `mcp`, since it imports a library of that name.
"""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING

import anyio
import click

from fibaction.border.urls import without_settings
from fibaction.cli.arguments.options import reject_inproc, url_of
from fibaction.cli.output.lines import note, say
from fibaction.cli.process.exit_codes import ExitCode, Failure, run
from fibaction.cli.process.last_seconds import LastSeconds
from fibaction.cli.process.logs import log_with_time
from fibaction.cli.process.signals import stop_signals
from fibaction.words.errors import TransportError

if TYPE_CHECKING:
    from fibaction_transports.mcp import McpBridge

TOKEN = "FIBACTION_MCP_TOKEN"
"""The variable with the token that clients over HTTP need."""
LAST_SECONDS = 0.5
"""Seconds that the process has to end: a thread of it may still wait for a line of stdin."""
_NAMED = re.compile(r"(?:(?P<name>\w+)=)?(?P<url>[\w+.-]+://.*)", re.ASCII | re.DOTALL)


@click.command(
    "mcp",
    epilog="""\b
Examples:
  fibaction mcp tcp://192.168.0.7:7400
  fibaction mcp ros2:// --allow 'arm/*' --unasked arm/look
  fibaction mcp left=tcp://192.168.0.7:7400 right=tcp://192.168.0.8:7400
  fibaction mcp nats://127.0.0.1/fleet --read-only --http :8090""",
)
@click.argument("addresses", metavar="[[NAME=]URL]...", nargs=-1)
@click.option(
    "--allow",
    metavar="NAME",
    multiple=True,
    help="Show this action only, or arm/*; may be given several times.",
)
@click.option(
    "--unasked",
    metavar="NAME",
    multiple=True,
    help="Send goals of this action without a question to the user.",
)
@click.option("--read-only", is_flag=True, help="Show goals, and let none be sent or canceled.")
@click.option(
    "--patience",
    type=click.FloatRange(min=0, min_open=True),
    default=50.0,
    show_default=True,
    help="Seconds after which a tool answers that its goal still runs.",
)
@click.option("--http", metavar="[HOST]:PORT", help="Serve over HTTP here, not over stdio.")
@click.option("--cert", metavar="FILE", help="With --http: the certificate for TLS.")
@click.option("--key", metavar="FILE", help="With --http: the key of the certificate.")
@click.option("--insecure", is_flag=True, help="With --http: without TLS beyond this machine.")
@click.pass_context
def mcp_command(
    context: click.Context,
    addresses: tuple[str, ...],
    allow: tuple[str, ...],
    unasked: tuple[str, ...],
    read_only: bool,
    patience: float,
    http: str | None,
    cert: str | None,
    key: str | None,
    insecure: bool,
) -> None:
    """Serve actions as tools of language models, by the Model Context Protocol.

    A client, such as an assistant or an editor, starts this command, and speaks to it over stdin
    and stdout. With --http it runs by itself, and clients need the token that it prints, or the one
    in FIBACTION_MCP_TOKEN.

    The user is asked before each goal. A client that cannot ask its user cannot send goals, but
    those of the actions in --unasked.

    Ctrl-C, SIGTERM or the end of stdin ends it. Goals that a tool waits for are canceled, all
    others go on at their server. A second signal ends it at once.
    """
    if find_spec("mcp") is None:
        raise Failure("fibaction mcp needs mcp: pip install 'fibaction[mcp]'", ExitCode.USAGE)
    if http is None and (cert or key or insecure):
        raise Failure("--cert, --key and --insecure are settings of --http", ExitCode.USAGE)
    servers = named_servers(addresses or (url_of(context),))
    from fibaction_transports.mcp import (  # their imports would slow down --help
        AgentPolicy,
        McpBridge,
    )

    try:
        policy = AgentPolicy(allow or ("*",), unasked, read_only, patience)
        bridge = McpBridge(servers, policy)
        where = None if http is None else host_and_port(http)
    except ValueError as exc:
        raise Failure(str(exc), ExitCode.USAGE) from exc
    with log_with_time():
        if where is not None:
            run(serve_http, bridge, *where, cert=cert, key=key, insecure=insecure)
        with LastSeconds(LAST_SECONDS, ExitCode.SUCCEEDED) as last:
            run(serve_stdio, bridge, last)


def named_servers(addresses: Sequence[str]) -> dict[str, str]:
    """Return the URLs of servers by their names; the name of a single one may be empty.

    Raises:
        Failure: A name is missing or given twice, or an address is not a URL.
    """
    servers: dict[str, str] = {}
    for text in addresses:
        found = _NAMED.fullmatch(text)
        if found is None:
            shown = without_settings(text)
            raise Failure(f"{shown!r} is not a URL, nor NAME=URL", ExitCode.USAGE)
        name, url = found["name"] or "", found["url"]
        reject_inproc(url)
        if len(addresses) > 1 and not name:
            shown = without_settings(url)
            raise Failure(
                f"several servers need names, which become part of the tools: left={shown}",
                ExitCode.USAGE,
            )
        if name in servers:
            raise Failure(f"two servers have the name {name}", ExitCode.USAGE)
        servers[name] = url
    return servers


def host_and_port(address: str) -> tuple[str, int]:
    """Return the parts of `[HOST]:PORT`; without a host it is this machine only.

    Raises:
        ValueError: It has another form.
    """
    host, colon, port = address.rpartition(":")
    if not (colon and port.isascii() and port.isdecimal() and int(port) < 65536):
        raise ValueError(f"--http is like :8090 or 127.0.0.1:8090, not {address!r}")
    return host.strip("[]") or "127.0.0.1", int(port)


async def serve_stdio(bridge: McpBridge, last: LastSeconds) -> int:
    """Serve a client over stdin and stdout, until it closes stdin or a signal comes."""
    async with stop_signals() as stop, bridge, anyio.create_task_group() as tasks:

        async def end_by_signal() -> None:
            await stop.wait()
            tasks.cancel_scope.cancel()

        note(opening(bridge, "stdin and stdout"))
        tasks.start_soon(end_by_signal)
        await bridge.run_stdio()
        tasks.cancel_scope.cancel()
    last.begin()
    return ExitCode.SUCCEEDED


async def serve_http(
    bridge: McpBridge, host: str, port: int, *, cert: str | None, key: str | None, insecure: bool
) -> int:
    """Serve clients over HTTP, until a signal comes.

    Raises:
        Failure: It cannot be served there.
    """
    from fibaction_transports.mcp._mcp_http import served_over_http

    given = os.environ.get(TOKEN)
    token = given or secrets.token_urlsafe(16)
    try:
        async with (
            stop_signals() as stop,
            bridge,
            served_over_http(
                bridge.server, host, port, token, cert=cert, key=key, insecure=insecure
            ) as url,
        ):
            secret = f"the token in {TOKEN}" if given else f"the token {token}"
            say(f"{opening(bridge, f'{url} with {secret}')}, Ctrl-C stops it")
            await stop.wait()
    except ValueError as exc:
        raise Failure(f"{TOKEN}: {exc}", ExitCode.USAGE) from exc
    except TransportError as exc:
        raise Failure(str(exc), ExitCode.USAGE) from exc
    return ExitCode.SUCCEEDED


def opening(bridge: McpBridge, where: str) -> str:
    """Return the line about the tools that there are at the start."""
    text = f"serving the tools {', '.join(bridge.tools)} over {where}"
    for name, problem in bridge.problems.items():
        text += f"; {name or 'the server'} cannot be reached yet: {problem}"
    return text

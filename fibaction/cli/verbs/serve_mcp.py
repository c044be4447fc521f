"""`fibaction mcp`: the actions of servers as tools of language models, with the extra `mcp`.

They are served by `mcp+stdio://` or `mcp+http://`; here are only the options. The module is not
called `mcp`, since that is the name of a library.
"""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Sequence
from typing import Any, cast

import anyio
import click

from fibaction.border.gateway import Gateway, GatewayTransport, ServerGroup
from fibaction.border.urls import transport_for, without_settings
from fibaction.cli.arguments.options import NumberType, reject_inproc, url_of
from fibaction.cli.output.lines import log_with_time, note, say
from fibaction.cli.process.exit_codes import ExitCode, Failure, check_installed, run
from fibaction.cli.process.signals import LastSeconds, stop_signals
from fibaction.observe.followed_servers import FollowedServers
from fibaction.wire.auth import check_token
from fibaction.wire.transport import TlsFiles
from fibaction.words.errors import TransportError

TOKEN = "FIBACTION_MCP_TOKEN"
"""The variable with the token that clients over HTTP need."""
STDIO = "mcp+stdio://"
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
    help="Send goals of this action without asking the user.",
)
@click.option("--read-only", is_flag=True, help="Show goals, but do not send or cancel any.")
@click.option(
    "--patience",
    type=NumberType(),
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

    The user is asked before each goal. A client that cannot ask its user can
    send goals of the actions in --unasked only.

    Ctrl-C, SIGTERM or the end of stdin ends it. Goals that a tool waits for are canceled, all
    others continue at their server. A second signal ends it at once.
    """
    check_installed("mcp", "fibaction mcp", "mcp")
    if http is None and (cert or key or insecure):
        raise Failure("--cert, --key and --insecure are settings of --http")
    servers = named_servers(addresses or (url_of(context),))
    rules: dict[str, Any] = {
        "allow": allow or ("*",),
        "unasked": unasked,
        "read_only": read_only,
        "patience": patience,
    }
    secret = ""
    if http is not None:
        token, secret = token_and_its_source()
        files = TlsFiles(cert=cert, key=key) if cert or key else None
        rules |= {"token": token, "tls": files, "insecure": insecure}
    try:
        url = STDIO if http is None else url_of_http(http, has_tls=bool(cert or key))
        transport = cast("GatewayTransport", transport_for(url, **rules))
    except (TransportError, ValueError) as exc:
        raise Failure(str(exc)) from exc
    group = FollowedServers(servers)
    with log_with_time(), LastSeconds(LAST_SECONDS, ExitCode.SUCCEEDED) as last:
        run(serve_mcp, group, transport, secret, last)


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
            raise Failure(f"{shown!r} is not a URL, nor NAME=URL")
        name, url = found["name"] or "", found["url"]
        reject_inproc(url)
        if len(addresses) > 1 and not name:
            shown = without_settings(url)
            raise Failure(
                f"several servers need names, which become part of the tools: left={shown}"
            )
        if name in servers:
            raise Failure(f"two servers have the name {name}")
        servers[name] = url
    return servers


def url_of_http(address: str, *, has_tls: bool) -> str:
    """Return the URL for `[HOST]:PORT`; without a host it is this machine only.

    Raises:
        ValueError: The address has another form.
    """
    host, colon, port = address.rpartition(":")
    if not (colon and port.isascii() and port.isdecimal() and int(port) < 65536):
        raise ValueError(f"--http is like :8090 or 127.0.0.1:8090, not {address!r}")
    return f"{'mcp+https' if has_tls else 'mcp+http'}://{host or '127.0.0.1'}:{port}"


def token_and_its_source() -> tuple[str, str]:
    """Return the token that clients over HTTP need, and the words that tell the user which it is.

    Raises:
        Failure: The token in the environment cannot be one.
    """
    if given := os.environ.get(TOKEN):
        try:
            check_token(given)
        except ValueError as exc:
            raise Failure(f"{TOKEN}: {exc}") from exc
        return given, f"the token in {TOKEN}"
    token = secrets.token_urlsafe(16)
    return token, f"the token {token}"


async def serve_mcp(
    group: FollowedServers, transport: GatewayTransport, secret: str, last: LastSeconds
) -> int:
    """Serve the actions of servers, until a signal comes or the only client goes.

    `secret` tells the token that clients need; it is empty if they need none.

    Raises:
        Failure: They cannot be served there.
    """
    try:
        async with (
            stop_signals() as stop,
            group,
            transport.serve_group(group) as gateway,
            anyio.create_task_group() as tasks,
        ):

            async def end_with_client() -> None:
                await transport.wait_end()
                tasks.cancel_scope.cancel()

            if secret:
                say(f"{opening(gateway, group, f'{gateway.url} with {secret}')}, Ctrl-C stops it")
            else:
                note(opening(gateway, group, "stdin and stdout"))
            tasks.start_soon(end_with_client)
            await stop.wait()
            tasks.cancel_scope.cancel()
    except TransportError as exc:
        raise Failure(str(exc)) from exc
    last.begin()
    return ExitCode.SUCCEEDED


def opening(gateway: Gateway, group: ServerGroup, where: str) -> str:
    """Return the line about the tools that there are at the start."""
    text = f"serving the tools {', '.join(gateway.names)} over {where}"
    for name, problem in group.problems.items():
        if problem:
            text += f"; {name or 'the server'} cannot be reached yet: {problem}"
    return text

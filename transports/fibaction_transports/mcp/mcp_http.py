"""MCP over HTTP ("streamable HTTP"), by uvicorn, which the SDK brings with it.

Requests are let in by the rules of this project's web servers: the `Host` must be this machine or
an address, the `Origin` none or the same, and the token must be right, before anything is read. So
no page of a browser and no other user of the machine can move a robot.
"""

from __future__ import annotations

import socket
import ssl
from collections.abc import AsyncGenerator, Awaitable, Callable, Generator, MutableMapping
from contextlib import asynccontextmanager, contextmanager
from functools import partial
from ipaddress import ip_address
from typing import Any, cast

import anyio
import uvicorn
from mcp.server import Server
from mcp.server.transport_security import TransportSecuritySettings

from fibaction.border.http_access import HttpRules, Refused
from fibaction.border.peer_text import clean_logger
from fibaction.wire.auth import AccessPolicy
from fibaction.wire.settings import Limits
from fibaction.words.errors import TransportError
from fibaction_transports.mcp.places import ConnectionPlaces, LimitedConnection

PATH = "/mcp"
LAST_ANSWERS = 1
"""Seconds that clients have for their last answers at the end."""

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Scope]]
Send = Callable[[Scope], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

logger = clean_logger("fibaction.mcp")


class Guarded:
    """An ASGI application that lets in only the requests that are permitted."""

    def __init__(self, app: App, admitted: HttpRules, access: AccessPolicy) -> None:
        self._app = app
        self._rules = admitted
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            try:
                self._check(scope)
            except Refused as exc:
                await _refuse(exc, send)
                return
        await self._app(scope, receive, send)

    def _check(self, scope: Scope) -> None:
        """Check the host, the page and the token of a request.

        Raises:
            Refused: One of them is not permitted.
        """
        headers: dict[str, str] = {}
        for name, value in scope["headers"]:
            key, text = name.decode("latin-1").lower(), value.decode("latin-1")
            # A header that comes twice is a trick, and fits nothing.
            headers[key] = f"{headers[key]}, {text}" if key in headers else text
        self._rules.check_sources(headers, has_tls=scope.get("scheme") == "https")
        scheme, _, token = headers.get("authorization", "").partition(" ")
        host, port = scope.get("client") or ("a client", 0)
        bearer = token.strip().encode("latin-1").decode(errors="replace")
        if scheme.lower() != "bearer" or self._access.admit(f"{host}:{port}", bearer) is None:
            reason = "the header Authorization must be: Bearer, and the token of the bridge"
            raise Refused(401, reason, ("WWW-Authenticate", "Bearer"))


async def _refuse(refused: Refused, send: Send) -> None:
    logger.warning("HTTP %d: %s", refused.status, refused, extra={"kind": refused.status})
    body = f"{refused}\n".encode()
    headers = [
        (name.lower().encode(), value.encode("latin-1"))
        for name, value in (
            *refused.headers,
            ("Content-Type", "text/plain; charset=utf-8"),
            ("Content-Length", str(len(body))),
        )
    ]
    await send({"type": "http.response.start", "status": refused.status, "headers": headers})
    await send({"type": "http.response.body", "body": body})


def http_app(server: Server[Any], host: str, admitted: HttpRules, access: AccessPolicy) -> App:
    """Return the application for a server that listens at a host."""
    # The rules above are stricter.
    off = TransportSecuritySettings(enable_dns_rebinding_protection=False)
    app = server.streamable_http_app(streamable_http_path=PATH, transport_security=off, host=host)
    return Guarded(app, admitted, access)


class _Uvicorn(uvicorn.Server):
    """A uvicorn that leaves the signals to its caller, and tells when it has started."""

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.has_started = anyio.Event()

    @contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self.has_started.set()


@asynccontextmanager
async def served_over_http(
    app: App, host: str, port: int, tls: ssl.SSLContext | None, limits: Limits
) -> AsyncGenerator[int, None]:
    """Serve an application during the block, which gets the port. It runs on asyncio only.

    Port 0 is a free one. Of the limits, those of connections hold.

    Raises:
        TransportError: Nothing can listen there.
    """
    listener = _listening(host, port)
    config = uvicorn.Config(
        app,
        http=cast("Any", partial(LimitedConnection, ConnectionPlaces(limits))),
        ws="none",
        lifespan="on",
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=LAST_ANSWERS,
    )
    config.load()
    config.ssl = tls
    running = _Uvicorn(config)

    async def run() -> None:
        with anyio.CancelScope(shield=True):  # canceled, it would leave tasks of its own behind
            await running.serve([listener])

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(run)
        with anyio.CancelScope(shield=True):  # told to end before, it would close nothing
            await running.has_started.wait()
        try:
            yield listener.getsockname()[1]
        finally:
            running.should_exit = True


def _listening(host: str, port: int) -> socket.socket:
    """Return a socket that listens.

    Raises:
        TransportError: It cannot.
    """
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family)
    except OSError as exc:
        raise TransportError(f"cannot listen at {host}:{port}: {exc.strerror or exc}") from exc


def is_loopback(host: str) -> bool:
    """Return whether a host can be reached from this machine only."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False

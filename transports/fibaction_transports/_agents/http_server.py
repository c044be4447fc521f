"""The HTTP server for agents: uvicorn, which the extras bring, and which runs on asyncio only."""

from __future__ import annotations

import socket
import ssl
from collections.abc import AsyncGenerator, Generator
from contextlib import asynccontextmanager, contextmanager
from functools import partial
from ipaddress import ip_address
from typing import Any, cast

import anyio
import uvicorn

from fibaction.wire.settings import Limits
from fibaction.words.errors import TransportError
from fibaction_transports._agents.http_guard import App
from fibaction_transports._agents.places import ConnectionPlaces, LimitedConnection

SEND_BUFFER = 2**16
"""Bytes of a connection that the system may hold, so that little is lost with a connection."""
LAST_ANSWERS = 1
"""Seconds that clients have for their last answers at the end."""


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
        listener = socket.create_server((host, port), family=family)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        return listener
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

"""`http://host:port/path` and `https://host:port/path`: everything for web clients."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any, ClassVar, Unpack

from anyio.abc import Listener

from fibaction.border.event_loop import asyncio_task
from fibaction.border.settings import TransportSettings
from fibaction.observe.metrics import Metrics
from fibaction.wire.wire_server import WireServer
from fibaction_transports._socket_lines.sockets import accept_sockets
from fibaction_transports._socket_lines.tls import TlsListener
from fibaction_transports.web.http.application import WebApplication
from fibaction_transports.web.http.handshake import http_answer
from fibaction_transports.web.http.server import HttpServer
from fibaction_transports.web.websocket_transport import (
    HOST,
    WebSocketLineTransport,
    WebSocketSettings,
)

if TYPE_CHECKING:
    from fibaction_transports.keywords import HttpKeywords


class HttpSettings(WebSocketSettings, frozen=True, kw_only=True):
    """The settings of an `HttpTransport`."""

    only_for_servers: ClassVar[tuple[str, ...]] = (
        *WebSocketSettings.only_for_servers,
        "console",
        "metrics",
        "recording",
    )

    console: bool = True
    """Serve the console as a page at the path of a server."""
    metrics: Metrics | None = None
    """Serve these at `/metrics` of a server; they are a watcher, too, for `serve`."""
    recording: str | PathLike[str] | None = None
    """The file of a recording to serve at `/recording`, which the console shows at the address
    `?recording=NAME`."""


class HttpTransport(WebSocketLineTransport):
    """HTTP and WebSocket at one address, with or without TLS.

    A server has all that a `WebTransport` has. A client connects by WebSocket, to `http://` as to
    `ws://`.
    """

    settings_type: ClassVar[type[TransportSettings]] = HttpSettings
    plain_scheme = "http"
    tls_schemes: ClassVar[tuple[str, ...]] = ("https",)
    speaks_tls = http_answer(400, "this server speaks TLS: use https://")

    def __init__(
        self,
        host: str = HOST,
        port: int | None = None,
        path: str = "/",
        **settings: Unpack[HttpKeywords],
    ) -> None:
        """Take an address and settings.

        Args:
            host: The host to connect to, or to listen at.
            port: The port, as for `WebSocketTransport`.
            path: The path of the server; it begins with `/`.
            settings: See the table of settings.

        Raises:
            TypeError, ValueError: As for `WebSocketTransport`.
        """
        made = HttpSettings.of(self, settings)
        super().__init__(host, port, path, made)
        self._console = made.console
        self._metrics = made.metrics
        self._recording = made.recording

    @cached_property
    def _served(self) -> dict[WireServer, HttpServer]:
        return {}

    @asynccontextmanager
    async def accept_lines(self, server: WireServer) -> AsyncGenerator[str, None]:
        admitted = self._rules()
        application = WebApplication(
            server,
            admitted,
            console=self._console,
            metrics=self._metrics,
            recording=self._recording,
        )
        self._served[server] = HttpServer(application, server, admitted, self._scheme)
        try:
            async with super().accept_lines(server) as url:
                try:
                    yield url
                finally:
                    await application.close()
        finally:
            del self._served[server]

    async def _accept_all(self, listener: Listener[Any], server: WireServer) -> None:
        served = self._served[server]
        if asyncio_task() is not None and not isinstance(listener, TlsListener):
            await accept_sockets(listener, served.serve_socket, server.tasks)
        else:
            await listener.serve(served.serve, server.tasks)

"""`http://host:port/path` and `https://host:port/path`: everything for web clients.

A stream of WebSocket is handed to the wire protocol, which works on it without ASGI between (on
asyncio without TLS, as a `ProtocolLine` over the socket), or to the guest of the application.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Iterable
from contextlib import asynccontextmanager
from dataclasses import replace
from os import PathLike
from typing import TYPE_CHECKING, ClassVar, Unpack

from fibaction.border.http_access import headers_in
from fibaction.border.settings import TransportSettings
from fibaction.observe.metrics import Metrics
from fibaction.observe.sources import Sources
from fibaction.wire.channel import Line, StreamChannel
from fibaction.wire.wire_server import Candidate, WireServer
from fibaction_transports._http.server import SPEAKS_TLS, HttpServer, Upgrade
from fibaction_transports._socket_lines.on_asyncio import LineMaker
from fibaction_transports._socket_lines.sockets import SocketStream
from fibaction_transports.web.http.application import WebApplication
from fibaction_transports.web.http.handshake import ServerHandshake
from fibaction_transports.web.http.websocket_frames import BinaryMessages, WebSocketFraming
from fibaction_transports.web.rosbridge.server.channel import RosbridgeGuest
from fibaction_transports.web.websocket_transport import (
    HOST,
    WebSocketLineTransport,
    WebSocketSettings,
)

if TYPE_CHECKING:
    from fibaction_transports.keywords import HttpKeywords


class WebServer(HttpServer):
    """Serves HTTP and WebSocket to every client that connects, within the limits."""

    speaks_websocket = True

    def __init__(self, application: WebApplication, scheme: str) -> None:
        super().__init__(application, application.rules.path, scheme)
        self._application = application
        self._server = application.server
        self.addresses = self._server.addresses
        self.turn = self._server.turn
        self._lines: LineMaker | None = None  # which only asyncio has

    def silent(self) -> Iterable[Candidate]:
        return self._server.silent()

    async def upgrade(self, upgrade: Upgrade) -> None:
        rules = self._application.rules
        path = upgrade.request.target.decode("ascii").partition("?")[0]
        if f"{path}/" == rules.path or path == f"{rules.path}/":
            rules = replace(rules, path=path)
        headers = headers_in(upgrade.request.headers)
        if "sec-websocket-protocol" in headers:
            messages = BinaryMessages(self._server.new_reader())
            framing = WebSocketFraming("the client", messages, ServerHandshake(rules))
            line = await self._line(upgrade, framing)
            upgrade.place.leave()  # the line takes it
            await self._server.serve(line)
        else:
            upgrade.place.leave()  # the channel of the guest takes it
            await self._application.guest.serve_stream(
                self._server, upgrade.buffered(), upgrade.peer, headers, rules
            )

    async def _line(self, upgrade: Upgrade, framing: WebSocketFraming) -> Line:
        """Give up the stream for a line, which begins with what was read of the request."""
        if not isinstance(upgrade.stream, SocketStream):
            return StreamChannel(upgrade.buffered(), upgrade.peer, framing)
        if self._lines is None:
            self._lines = LineMaker()
        return await self._lines.make(upgrade.stream.detach(), framing, upgrade.received)


class HttpSettings(WebSocketSettings, frozen=True, kw_only=True):
    """The settings of an `HttpTransport`."""

    only_for_servers: ClassVar[tuple[str, ...]] = (
        *WebSocketSettings.only_for_servers,
        "console",
        "metrics",
        "recording",
        "sources",
    )

    console: bool = True
    """Serve the console as a page at the path of a server."""
    metrics: Metrics | None = None
    """Serve these at `/metrics` of a server; they are a watcher, too, for `serve`."""
    recording: str | PathLike[str] | None = None
    """The file of a recording to serve at `/recording`, which the console shows at the address
    `?recording=NAME`."""
    sources: Sources | None = None
    """The servers whose actions are served: the console lists them, and has their topics."""


class HttpTransport(WebSocketLineTransport):
    """HTTP and WebSocket at one address, with or without TLS.

    A server has all that a `WebTransport` has. A client connects by WebSocket, to `http://` as to
    `ws://`.
    """

    settings_type: ClassVar[type[TransportSettings]] = HttpSettings
    plain_scheme = "http"
    tls_schemes: ClassVar[tuple[str, ...]] = ("https",)
    speaks_tls = SPEAKS_TLS

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
        self._sources = made.sources

    @asynccontextmanager
    async def accept_lines(self, server: WireServer) -> AsyncGenerator[str, None]:
        application = WebApplication(
            server,
            self._rules(),
            RosbridgeGuest(),
            console=self._console,
            metrics=self._metrics,
            recording=self._recording,
            sources=self._sources,
        )
        listener, url = await self._listen()
        web = WebServer(application, self._scheme)
        async with web.accepting(listener, server.tasks, self.url):
            yield url

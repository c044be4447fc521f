"""`WebServer`: an `HttpServer` whose clients may speak WebSocket.

A stream of WebSocket is handed to the wire protocol, which works on it without ASGI between (on
asyncio without TLS, as a `ProtocolLine` over the socket), or to the guest of the application.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from fibaction.border.http_access import headers_in
from fibaction.wire.channel import Line, StreamChannel
from fibaction.wire.server.addresses import Candidate
from fibaction_transports._http.server import HttpServer, Upgrade
from fibaction_transports._socket_lines.on_asyncio import LineMaker
from fibaction_transports._socket_lines.sockets import SocketStream
from fibaction_transports.web.http.application import WebApplication
from fibaction_transports.web.http.handshake import ServerHandshake
from fibaction_transports.web.http.websocket_frames import BinaryMessages, WebSocketFraming


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

"""`WebApplication`: the ASGI application of one server.

Theory of operation
-------------------

An ASGI server calls the application for each request and for each WebSocket, in a task of its own.
What the client says decides what it gets, at one address:

- WebSocket with the subprotocol `fibaction.1`: the wire protocol, a `Session` of the `WireServer`.
- WebSocket without a subprotocol: rosbridge, which is another form of such a `Session`.
- HTTP: the files of the console and of the client for JavaScript, the probes of operators, and the
  REST interface.

Before that the `Host` and the `Origin` are checked, for all of them; pages of `origins` get the
headers of CORS.

The application lives as long as the block of `serve`, which is in another task than the requests.
At its end, `close` waits a moment for the streams of events to tell the ends of goals, and cancels
what is left of HTTP. WebSockets end later: the `WireServer` says goodbye first, and the end of its
task group, in which `_hold` is, cancels the rest. So nothing runs after the block.
"""

from __future__ import annotations

from contextlib import suppress
from os import PathLike

import anyio
from anyio import CancelScope

from fibaction.border.abc import Notifier
from fibaction.border.http_access import HttpRules, Refused, headers_in
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.observe.metrics import Metrics
from fibaction.schema.payload import PayloadError
from fibaction.wire.errors import failure_of
from fibaction.wire.wire_server import LEAVE_TIMEOUT, WireServer
from fibaction.words.errors import ActionError, AuthenticationFailed
from fibaction_transports.web.http.asgi_channel import AsgiChannel
from fibaction_transports.web.http.assets import Assets, answer_with
from fibaction_transports.web.http.exchange import (
    Exchange,
    Receive,
    Scope,
    Send,
    path_of,
    peer_of,
)
from fibaction_transports.web.http.handshake import SUBPROTOCOL
from fibaction_transports.web.http.probes import Probes
from fibaction_transports.web.http.problems import RETRY, Problem, problem_of
from fibaction_transports.web.http.recording_answer import ServedRecording
from fibaction_transports.web.rest.handlers import RestInterface
from fibaction_transports.web.rosbridge.server.channel import (
    RosbridgeAsgiChannel,
    new_translator,
    serve_rosbridge,
)

NOT_SERVING = "the server does not run: serve() it in the lifespan of the program"
CORS = (
    ("Access-Control-Allow-Methods", "GET, POST, PUT, DELETE"),
    ("Access-Control-Allow-Headers", "authorization, content-type, last-event-id"),
    ("Access-Control-Max-Age", "600"),
)

logger = clean_logger("fibaction.web")


class WebApplication:
    """Answers the requests of all web clients of one server."""

    def __init__(
        self,
        server: WireServer,
        rules: HttpRules,
        *,
        console: bool = True,
        metrics: Metrics | None = None,
        recording: str | PathLike[str] | None = None,
    ) -> None:
        """Serve the console, too, unless it is not wanted, and metrics and a recording, if there
        are some.
        """
        self._server = server
        self._assets = Assets(console=console)
        self._rules = rules
        self._rest = RestInterface(server)
        self._probes = Probes(metrics, self._rest.admit)
        self._recording = ServedRecording(recording, self._rest.admit)
        self._requests: set[CancelScope] = set()
        self._sockets: set[CancelScope] = set()
        self._changed = Notifier()  # of both
        self.is_closing = False
        """True if no more requests are answered."""
        server.tasks.start_soon(self._hold)
        if metrics is not None:
            server.tasks.start_soon(metrics.run)

    async def _hold(self) -> None:
        try:
            await anyio.sleep_forever()
        finally:
            with CancelScope(shield=True):
                await self._end(self._sockets)

    async def close(self) -> None:
        """Answer no more requests; end those that have begun."""
        self.is_closing = True
        with CancelScope(shield=True):
            with anyio.move_on_after(LEAVE_TIMEOUT):
                while self._requests:
                    await self._changed.wait()
            await self._end(self._requests)

    async def _end(self, scopes: set[CancelScope]) -> None:
        while scopes:
            for scope in scopes:  # more may have come
                scope.cancel()
            await self._changed.wait()

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request or a WebSocket."""
        is_socket = scope["type"] == "websocket"
        scopes = self._sockets if is_socket else self._requests
        with CancelScope() as life:
            scopes.add(life)
            self._changed.notify()
            try:
                if is_socket:
                    await self._handle_socket(scope, receive, send)
                else:
                    limit, answers = self._server.settings.limits.write, self._server.frames
                    exchange = Exchange(scope, receive, send, limit, answers)
                    await self._handle_request(exchange)
            finally:
                scopes.discard(life)
                self._changed.notify()

    # HTTP

    async def _handle_request(self, exchange: Exchange) -> None:
        try:
            await self._answer(exchange)
        except Refused as exc:
            await self._tell(exchange, problem_of(exc))
        except (ActionError, PayloadError) as exc:
            is_wrong = isinstance(exc, PayloadError | AuthenticationFailed)
            await self._tell(exchange, problem_of(exc), is_wrong=is_wrong)
        except Exception as exc:
            # A bug of an endpoint or of fibaction. It concerns this client only.
            logger.error("%s: its request failed", exchange.peer, exc_info=exc)
            await self._tell(exchange, problem_of(failure_of(exc)), is_wrong=False)

    async def _answer(self, exchange: Exchange) -> None:
        headers = exchange.headers
        self._rules.check_sources(headers, has_tls=exchange.has_tls)
        if "origin" in headers:
            exchange.more_headers += [
                ("Access-Control-Allow-Origin", headers["origin"]),
                ("Access-Control-Expose-Headers", "location, link"),
                ("Vary", "Origin"),
            ]
        if self.is_closing:
            raise Refused(503, "the server is closing", RETRY)
        most = self._server.settings.limits.connections
        if len(self._requests) > most:
            raise Refused(503, f"the server is full: it answers {most} requests", RETRY)
        if exchange.method == "OPTIONS":
            await exchange.answer(204, b"", *CORS)
        elif exchange.path == "" and self._assets.has_page:
            # The addresses in the page are relative to its own.
            await exchange.answer(308, b"", ("Location", f"{exchange.root}/"))
        elif (asset := self._assets.find(exchange)) is not None:
            await answer_with(asset, exchange)
        elif not (await self._probes.answer(exchange) or await self._recording.answer(exchange)):
            await self._rest.handle(exchange)

    async def _tell(self, exchange: Exchange, problem: Problem, *, is_wrong: bool = True) -> None:
        """Answer with a problem, if there is no answer yet; log it if the request is wrong."""
        if is_wrong:
            detail = excerpt(problem.detail)
            kind = {"kind": problem.status}
            logger.warning("%s: HTTP %d: %s", exchange.peer, problem.status, detail, extra=kind)
        if not exchange.has_begun:
            with suppress(ActionError):  # the client may have gone
                await exchange.tell(problem)

    # WebSocket

    async def _handle_socket(self, scope: Scope, receive: Receive, send: Send) -> None:
        peer = peer_of(scope)
        await receive()  # websocket.connect
        try:
            self._check_socket(scope)
        except Refused as exc:
            reason = excerpt(str(exc))
            logger.warning("%s: HTTP %d: %s", peer, exc.status, reason, extra={"kind": exc.status})
            await _refuse_socket(scope, send, problem_of(exc))
            return
        if not scope.get("subprotocols"):
            await send({"type": "websocket.accept"})
            translator = new_translator(self._server, peer, headers_in(scope["headers"]))
            await serve_rosbridge(
                self._server, RosbridgeAsgiChannel(receive, send, peer, translator)
            )
            return
        await send({"type": "websocket.accept", "subprotocol": SUBPROTOCOL})
        reader = self._server.new_reader()
        await self._server.serve(AsgiChannel(receive, send, peer, reader))

    def _check_socket(self, scope: Scope) -> None:
        has_tls = scope.get("scheme") == "wss"
        self._rules.check_sources(headers_in(scope["headers"]), has_tls=has_tls)
        if path_of(scope) not in ("", "/"):
            raise Refused(404, f"there is no WebSocket at {excerpt(path_of(scope))}")
        offered = scope.get("subprotocols")
        if offered and SUBPROTOCOL not in offered:
            raise Refused(400, f"the request must offer the subprotocol {SUBPROTOCOL}")
        if self.is_closing:
            raise Refused(503, "the server is closing", RETRY)


async def refuse(scope: Scope, receive: Receive, send: Send) -> None:
    """Answer while the server does not run."""
    problem = Problem(503, NOT_SERVING, headers=(RETRY,))
    if scope["type"] == "websocket":
        await receive()
        await _refuse_socket(scope, send, problem)
    else:
        await Exchange(scope, receive, send).tell(problem)


async def _refuse_socket(scope: Scope, send: Send, problem: Problem) -> None:
    """Answer the request for a WebSocket with a problem, or with 403 if the server cannot."""
    if "websocket.http.response" not in scope.get("extensions", {}):
        await send({"type": "websocket.close"})
        return
    headers = [(b"content-type", b"application/problem+json")]
    await send(
        {"type": "websocket.http.response.start", "status": problem.status, "headers": headers}
    )
    await send({"type": "websocket.http.response.body", "body": problem.body})

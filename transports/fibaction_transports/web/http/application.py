"""`WebApplication`: the ASGI application of one server for web clients.

What the client says decides what it gets, at one address:

- WebSocket with the subprotocol `fibaction.1`: the wire protocol, a `Session` of the `WireServer`.
- WebSocket without a subprotocol: the protocol of a `SocketGuest`.
- HTTP: the files of the console and of the client for JavaScript, the probes of operators, and the
  REST interface.

WebSockets end later than requests: the `WireServer` says goodbye first, and the end of its task
group, in which `_hold` is, cancels the rest.

Over ASGI, the server of the application assembles the messages of a WebSocket, so its own limit is
the one that counts before a message is here: 16 MiB with uvicorn and hypercorn.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from os import PathLike

import anyio
from anyio import CancelScope
from anyio.abc import ByteStream

from fibaction.border.http_access import HttpRules, Refused, headers_in
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.observe.metrics import Metrics
from fibaction.observe.sources import Sources
from fibaction.wire.channel import LEAVE, Channel
from fibaction.wire.frames import framed
from fibaction.wire.wire_server import WireServer
from fibaction.words.errors import ConnectionLost
from fibaction_transports._http.application import EVERY_METHOD, HttpApplication
from fibaction_transports._http.exchange import (
    Exchange,
    Receive,
    Scope,
    Send,
    path_of,
    peer_of,
)
from fibaction_transports._http.problems import RETRY, Problem, problem_of
from fibaction_transports.web.http.handshake import SUBPROTOCOL
from fibaction_transports.web.http.plain_paths import READ_ONLY, PlainPaths
from fibaction_transports.web.http.websocket_frames import BinaryMessages, SocketMessages
from fibaction_transports.web.rest.handlers import RestInterface

NOT_SERVING = "the server does not run: serve() it in the lifespan of the program"

logger = clean_logger("fibaction.web")


class SocketGuest(ABC):
    """Another protocol than ours over WebSocket, for clients that offer no subprotocol."""

    @abstractmethod
    async def serve_stream(
        self,
        server: WireServer,
        stream: ByteStream,
        peer: str,
        headers: Mapping[str, str],
        rules: HttpRules,
    ) -> None:
        """Serve one client until its connection ends. The stream begins with its request."""

    @abstractmethod
    async def serve_asgi(
        self,
        server: WireServer,
        receive: Receive,
        send: Send,
        peer: str,
        headers: Mapping[str, str],
    ) -> None:
        """Serve one client, whose WebSocket was accepted, until its connection ends."""


class WebApplication(HttpApplication):
    """Answers the requests of all web clients of one server."""

    def __init__(
        self,
        server: WireServer,
        rules: HttpRules,
        guest: SocketGuest,
        *,
        console: bool = True,
        metrics: Metrics | None = None,
        recording: str | PathLike[str] | None = None,
        sources: Sources | None = None,
    ) -> None:
        """Serve the console, too, unless it is not wanted, and metrics, a recording and a list of
        servers, if there are some.
        """
        super().__init__(rules, server.settings.limits, server.frames)
        self.server = server
        self.guest = guest
        self._rest = RestInterface(server)
        self._plain = PlainPaths(
            self._rest.admit,
            server.endpoints,
            console=console,
            metrics=metrics,
            recording=recording,
            sources=sources,
        )
        self._sockets: set[CancelScope] = set()
        server.tasks.start_soon(self._hold)
        if metrics is not None:
            server.tasks.start_soon(metrics.run)

    async def _hold(self) -> None:
        try:
            await anyio.sleep_forever()
        finally:
            with CancelScope(shield=True):
                await self._end(self._sockets)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request or a WebSocket, as ASGI defines it."""
        if scope["type"] == "websocket":
            with self._counted(self._sockets):
                await self._handle_socket(scope, receive, send)
        else:
            await super().__call__(scope, receive, send)

    def allowed(self, path: str) -> str:
        try:
            return READ_ONLY if self._plain.has(path) else self._rest.allowed_at(path)
        except Refused:
            return EVERY_METHOD

    async def answer(self, exchange: Exchange) -> None:
        if not await self._plain.answer(exchange):
            await self._rest.handle(exchange)

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
            headers = headers_in(scope["headers"])
            await self.guest.serve_asgi(self.server, receive, send, peer, headers)
            return
        await send({"type": "websocket.accept", "subprotocol": SUBPROTOCOL})
        messages = BinaryMessages(self.server.new_reader())
        await self.server.serve(AsgiChannel(receive, send, peer, messages))

    def _check_socket(self, scope: Scope) -> None:
        has_tls = scope.get("scheme") == "wss"
        self.rules.check_sources(headers_in(scope["headers"]), has_tls=has_tls)
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


class AsgiChannel(Channel):
    """One connection that an ASGI server has accepted."""

    def __init__(self, receive: Receive, send: Send, peer: str, messages: SocketMessages) -> None:
        self.peer = peer
        self._receive = receive
        self._send = send
        self._messages = messages
        self._is_lost = False

    async def send(self, frames: Sequence[bytes]) -> None:
        await self._write(bytes=framed(frames))

    async def _write(self, **message: bytes | str) -> None:
        try:
            await self._send({"type": "websocket.send", **message})
        except (OSError, RuntimeError) as exc:  # servers differ in it
            self._is_lost = True
            raise ConnectionLost(f"the connection to {self.peer} broke") from exc

    async def receive(self) -> list[bytes]:
        message = await self._receive()
        if message["type"] == "websocket.disconnect":
            self._is_lost = True
            reason = excerpt(message.get("reason") or "")
            code = message.get("code", "")
            raise ConnectionLost(f"{self.peer} closed: {code} {reason}".rstrip())
        data = message.get("bytes")
        text = message.get("text") or ""
        return self._messages.take(text if data is None else data, is_last=True)

    def _closing(self) -> tuple[int, str]:
        """Return the code and the reason of our close."""
        return self._messages.code, ""

    async def aclose(self) -> None:
        self._messages.close()
        if not self._is_lost:
            code, reason = self._closing()
            close = {"type": "websocket.close", "code": code, "reason": reason}
            with anyio.move_on_after(LEAVE, shield=True), suppress(OSError, RuntimeError):
                await self._send(close)

"""`HttpServer`: an `HttpApplication` at an address of its own, over h11.

Theory of operation
-------------------

A task serves each connection. It reads the head of a request, of limited length and in limited
time, and then either hands the stream to the subclass, if WebSocket is asked for, or calls the
application. While that answers, what the client sends is read when the application asks for it, so
it knows at once if the client goes. After the answer the connection waits for the next request, for
a limited time.

If the limit of connections is reached, one that waits for a request is ended, or one whose client
does not read its answer: connections that say or read nothing keep no client out. It is one of the
address that has the most connections, of these one without any request first, and the oldest. What
a client has to read is one answer; its later requests wait in its socket.

Why not a server of others: with one stream open whose client reads nothing, hypercorn 0.18 does not
end. On asyncio it left two tasks behind, with tracebacks (Python 3.11), or had not ended after 30 s
(3.12); on trio it ended when the client did, after 29 s. It has no limit of connections, compresses
WebSocket whether one likes it or not, and logs no wrong request. uvicorn and granian do not run on
trio, and uvicorn does not end on Ctrl-C while a stream is open. As hosts of a `WebTransport` they
all work. This server ends 1.1 s after the signal, on both, with three such clients.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Generator, Iterable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from functools import partial
from socket import socket
from typing import Any, NamedTuple, TypeVar

import anyio
import h11
from anyio import CancelScope
from anyio.abc import ByteStream, Listener, TaskGroup
from anyio.streams.buffered import BufferedByteStream

from fibaction.border.event_loop import asyncio_task
from fibaction.border.http_access import Refused
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.wire.channel import CHUNK, LEAVE
from fibaction.wire.wire_server import Addresses, Candidate, too_many
from fibaction_transports._http.application import HttpApplication
from fibaction_transports._http.http_exchange import (
    LONGEST_HEAD,
    HttpExchange,
    http_answer,
    in_origin_form,
    is_upgrade,
)
from fibaction_transports._socket_lines.sockets import (
    BROKEN,
    SocketStream,
    accept_sockets,
    leave,
    peer_of,
)
from fibaction_transports._socket_lines.stream_transport import accepting
from fibaction_transports._socket_lines.tls import TlsListener

UNREAD = 1.0
"""Seconds after which a client that does not take its answer makes room for another one."""
SPEAKS_TLS = http_answer(400, "this server speaks TLS: use https://")
"""The answer of a server with TLS to a client that does not begin with TLS."""

PlaceT = TypeVar("PlaceT")

logger = clean_logger("fibaction.web")


class Upgrade(NamedTuple):
    """A connection whose client asks for WebSocket."""

    request: h11.Request
    stream: ByteStream
    received: bytes
    """The bytes that were read of the stream: the request, and maybe more."""
    peer: str
    place: CountedPlace

    def buffered(self) -> BufferedByteStream:
        """Return a stream that begins with what was read of the request."""
        stream = BufferedByteStream(self.stream)
        stream.feed_data(self.received)
        return stream


class HttpServer:
    """Serves an application to every client that connects, within the limits."""

    speaks_websocket = False
    """True if a request for WebSocket goes to `upgrade`, and not to the application."""

    def __init__(self, application: HttpApplication, path: str, scheme: str) -> None:
        """Serve the application at a path, which begins with `/`."""
        self.application = application
        self.limits = application.limits
        self.root = path.rstrip("/")
        self.scheme = scheme
        self.addresses = Addresses(self.limits.per_address)
        """The connections of each address."""
        self.turn = anyio.Lock()
        """The turn of the connections that ask before they have their answers."""
        self._open = 0
        # With their addresses, in the order of their begin: those that wait for a request, their
        # first one or another, and those whose clients have an answer to take, since when.
        self.new: dict[CancelScope, str] = {}
        self.idle: dict[CancelScope, str] = {}
        self._writing: dict[CancelScope, tuple[str, float]] = {}

    # The parts of a subclass

    async def upgrade(self, upgrade: Upgrade) -> None:
        """Serve a client of WebSocket until its connection ends, if `speaks_websocket`.

        Raises:
            Refused: The request is not permitted.
        """

    def silent(self) -> Iterable[Candidate]:
        """Return the connections of WebSocket that have said nothing yet."""
        return ()

    # The part that all have in common

    @asynccontextmanager
    async def accepting(
        self, listener: Listener[Any], tasks: TaskGroup, where: str
    ) -> AsyncGenerator[None, None]:
        """Serve each client that connects during the block in one of these tasks."""

        async def accept(listener: Listener[Any]) -> None:
            if asyncio_task() is not None and not isinstance(listener, TlsListener):
                await accept_sockets(listener, self.serve_socket, tasks)
            else:
                await listener.serve(self.serve, tasks)

        async with accepting(listener, accept, where):
            try:
                yield
            finally:
                await self.application.close()

    async def serve_socket(self, accepted: socket) -> None:
        """Serve one client on asyncio, without TLS, until its connection ends."""
        await self.serve(SocketStream(accepted))

    async def serve(self, stream: ByteStream) -> None:
        """Serve one client until its connection ends."""
        peer = peer_of(stream)
        place = CountedPlace(self.addresses, peer)
        try:
            if reason := self._why_not(place.address):
                place.leave()  # while it reads the answer it keeps no other client out
                logger.warning("%s is rejected: %s", peer, reason)
                await leave(stream, http_answer(503, reason, ("Retry-After", "1")))
            else:
                await self._serve(stream, peer, place)
        except BROKEN:
            pass
        except Exception as exc:
            # A bug of fibaction. It concerns this client only.
            logger.error("%s: the connection failed", peer, exc_info=exc)
        finally:
            place.leave()
            with CancelScope(shield=True), anyio.move_on_after(LEAVE), suppress(*BROKEN):
                await stream.aclose()

    async def _serve(self, stream: ByteStream, peer: str, place: CountedPlace) -> None:
        self._open += 1
        try:
            await _Connection(self, stream, peer, place).run()
        finally:
            self._open -= 1

    def _why_not(self, address: str) -> str:
        """Return the reason for which a client of that address is not served; empty if it is."""
        addresses, most = self.addresses, self.limits.connections
        if addresses.has_too_many(address) and not addresses.make_room(self._useless(), address):
            return too_many(address, addresses.most)
        if self._open >= most and not addresses.make_room(self._useless()):
            return f"the server is full: it has {most} connections"
        return ""

    def _useless(self) -> Iterator[Candidate]:
        """Yield the connections that have asked for nothing, then idle ones, then those whose
        clients do not read.
        """
        for scope, address in self.new.items():
            yield Candidate(address, partial(_end, self.new, scope))
        yield from self.silent()
        for scope, address in self.idle.items():
            yield Candidate(address, partial(_end, self.idle, scope))
        now = anyio.current_time()
        for scope, (address, since) in self._writing.items():
            if now - since > UNREAD:
                yield Candidate(address, partial(_end, self._writing, scope))

    async def write(self, stream: ByteStream, address: str, data: bytes) -> None:
        """Send a piece of an answer, unless its connection has to make room.

        Raises:
            anyio.BrokenResourceError: The client has gone, or has to go.
            OSError: The connection is broken.
        """
        if isinstance(stream, SocketStream) and not (data := stream.send_now(data)):
            return
        with self.among(self._writing, (address, anyio.current_time())) as scope:
            await stream.send(data)
        if scope.cancelled_caught:
            raise anyio.BrokenResourceError

    @contextmanager
    def among(
        self, scopes: dict[CancelScope, PlaceT], place: PlaceT
    ) -> Generator[CancelScope, None, None]:
        """Have the block among those that make room for others, by their cancelation."""
        with CancelScope() as scope:
            scopes[scope] = place
            try:
                yield scope
            finally:
                scopes.pop(scope, None)


class CountedPlace:
    """The place of one connection among those of its address."""

    def __init__(self, addresses: Addresses, peer: str) -> None:
        self.address = addresses.enter(peer)
        self._addresses: Addresses | None = addresses

    def leave(self) -> None:
        """Give the place up, if that was not done before."""
        addresses, self._addresses = self._addresses, None
        if addresses is not None:
            addresses.leave(self.address)


def _end(waiting: dict[CancelScope, Any], scope: CancelScope) -> None:
    del waiting[scope]
    scope.cancel()


class _Connection:
    """One connection."""

    def __init__(
        self, server: HttpServer, stream: ByteStream, peer: str, place: CountedPlace
    ) -> None:
        self._server = server
        self._stream = stream
        self._peer = peer
        self._place = place
        self._received = b""  # of the request that is being read
        self._has_asked = False
        self._begin()

    async def run(self) -> None:
        """Answer requests until the connection ends, or is another one's."""
        while True:
            try:
                request = await self._next_request()
                if request is None:
                    return
                path = request.target.decode("ascii").partition("?")[0]
                if not f"{path}/".startswith(f"{self._server.root}/") and path != "*":
                    raise Refused(
                        404, f"there is nothing at {path}: the server is at {self._server.root}"
                    )
                if self._server.speaks_websocket and is_upgrade(request):
                    stream, received = self._stream, self._received
                    await self._server.upgrade(
                        Upgrade(request, stream, received, self._peer, self._place)
                    )
                    return
                send = partial(self._server.write, self._stream, self._place.address)
                scheme, root = self._server.scheme, self._server.root
                exchange = HttpExchange(
                    self._http, self._stream, send, request, self._peer, scheme, root
                )
            except h11.RemoteProtocolError as exc:
                await self._refuse(Refused(exc.error_status_hint, str(exc)))
                return
            except Refused as exc:
                await self._refuse(exc)
                return
            self._has_asked = True
            application = self._server.application
            await application(exchange.scope, exchange.receive, exchange.send)
            if application.is_closing or not exchange.can_go_on():
                await leave(self._stream)
                return
            self._begin(self._http.trailing_data[0] + exchange.early)
            if self._received and not await self._take_turn():
                return

    def _begin(self, early: bytes = b"") -> None:
        """Begin to read a request, of which these bytes have arrived."""
        self._http = h11.Connection(h11.SERVER, max_incomplete_event_size=LONGEST_HEAD)
        self._received = b""
        self._take(early)

    def _take(self, data: bytes) -> None:
        """Take bytes that have arrived, without empty lines before a request (RFC 9112, 2.2)."""
        if not self._received:
            data = data.lstrip(b"\r\n")
        if data:  # nothing would be the end
            self._received += data
            self._http.receive_data(data)

    async def _next_request(self) -> h11.Request | None:
        """Return the next request; None if the connection has ended.

        Raises:
            h11.RemoteProtocolError: The client does not speak HTTP.
            Refused: The request has not arrived in time, or cannot be answered.
        """
        seconds = self._server.limits.handshake
        server = self._server
        waiting = server.idle if self._has_asked else server.new
        with server.among(waiting, self._place.address) as scope:
            scope.deadline = anyio.current_time() + seconds
            while (event := self._http.next_event()) is h11.NEED_DATA:
                await self._receive()
            return in_origin_form(event) if isinstance(event, h11.Request) else None
        if self._received:
            raise Refused(408, f"the request has not arrived within {seconds:g} s")
        return None

    async def _take_turn(self) -> bool:
        """Wait with all other clients that ask before they have their answers; return False if this
        connection has to make room meanwhile.
        """
        server = self._server
        with server.among(server.idle, self._place.address):
            async with server.turn:
                return True
        return False

    async def _receive(self) -> None:
        try:
            data = await self._stream.receive(CHUNK)
        except anyio.EndOfStream:
            self._http.receive_data(b"")
        else:
            self._take(data)

    async def _refuse(self, refused: Refused) -> None:
        """Answer a request that the application does not see."""
        reason = excerpt(str(refused))
        kind = {"kind": refused.status}
        logger.warning("%s: HTTP %d: %s", self._peer, refused.status, reason, extra=kind)
        await leave(self._stream, http_answer(refused.status, reason, *refused.headers))

"""The bases of transports over streams of bytes: `StreamTransport`, and `HostTransport` for servers
that have a host and a port, with or without TLS.
"""

from __future__ import annotations

import socket
import ssl
from abc import abstractmethod
from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from errno import EADDRINUSE
from functools import partial
from ipaddress import ip_address
from ssl import SSLContext
from typing import TYPE_CHECKING, Any, ClassVar
from urllib.parse import SplitResult

import anyio
from anyio.abc import Listener, SocketAttribute
from anyio.streams.stapled import MultiListener
from anyio.streams.tls import TLSStream

from fibaction.border.event_loop import Background, asyncio_task
from fibaction.border.peer_text import clean_logger
from fibaction.border.settings import TransportSettings
from fibaction.wire.channel import Line, StreamChannel
from fibaction.wire.frames import FrameReader, Framing
from fibaction.wire.settings import Limits, WireSettings
from fibaction.wire.transport import TlsFiles, WireTransport
from fibaction.words.errors import (
    AuthenticationFailed,
    ConnectionLost,
    InvalidURL,
    ServerNotFound,
    TransportError,
)
from fibaction_transports._socket_lines import on_asyncio, sockets
from fibaction_transports._socket_lines.on_asyncio import ClientTls
from fibaction_transports._socket_lines.tls import (
    SPEAKS_TLS,
    TlsChannel,
    TlsListener,
    no_tls,
    telling,
)

if TYPE_CHECKING:
    from fibaction.wire.wire_server import WireServer

MAX_PORT = 65535
"""The largest port: a number of 16 bits."""
ACCEPT_PAUSE = 0.1
"""Seconds without new connections after one could not be accepted: a lack of files passes."""

logger = clean_logger("fibaction.wire")


class StreamTransport(WireTransport):
    """A transport over streams of bytes."""

    plain_scheme: ClassVar[str] = "tcp"
    """Scheme of the URLs without TLS, for errors."""

    @abstractmethod
    async def _connect(self) -> Line:
        """Connect, and raise the errors of sockets as they are."""

    @abstractmethod
    async def _listen(self) -> tuple[Listener[Any], str]:
        """Begin to listen; return the URL as well."""

    def _new_framing(self, server: WireServer) -> Callable[[], Framing]:
        """Return what makes the form of the frames of a new line."""
        return server.new_reader

    def _unlisten(self) -> None:
        """Remove what new clients find the server by, before the listener is closed."""

    async def open_line(self) -> Line:
        try:
            return await self._connect()
        except ssl.SSLError as exc:
            raise AuthenticationFailed(no_tls(self.url, exc, self.plain_scheme)) from exc
        except OSError as exc:
            raise ServerNotFound(
                f"no server listens at {self.url} ({exc.strerror or exc}): start the server, or"
                f" wait for it with wait_for_server()"
            ) from exc
        except UnicodeError as exc:
            raise InvalidURL(f"invalid host in {self.url}: {exc}") from exc
        except (anyio.BrokenResourceError, anyio.EndOfStream) as exc:
            raise ConnectionLost(f"{self.url} closed the connection at once") from exc

    @asynccontextmanager
    async def accept_lines(self, server: WireServer) -> AsyncGenerator[str, None]:
        listener, url = await self._listen()
        async with accepting(listener, partial(self._accept_all, server), self.url):
            try:
                yield url
            finally:
                self._unlisten()

    async def _accept_all(self, server: WireServer, listener: Listener[Any]) -> None:
        """Serve each client that connects in a task of its own, until accepting fails.

        Raises:
            OSError: A connection could not be accepted.
        """
        new_framing = self._new_framing(server)
        if asyncio_task() is None:
            await sockets.accept_streams(listener, new_framing, server.serve, server.tasks)
        elif isinstance(listener, TlsListener):
            await on_asyncio.accept_tls(listener, new_framing, server.serve, server.tasks)
        else:
            await on_asyncio.accept(listener, new_framing, server.serve, server.tasks)


@asynccontextmanager
async def accepting(
    listener: Listener[Any], accept: Callable[[Listener[Any]], Awaitable[None]], where: str
) -> AsyncGenerator[None, None]:
    """Accept clients at each address of a listener during the block, and close it at the end.

    `accept` runs until accepting fails; `where` is for errors.
    """
    parts: Sequence[Listener[Any]] = [listener]
    if isinstance(listener, MultiListener):  # a host with several addresses
        parts = listener.listeners
    elif isinstance(listener, TlsListener):
        parts = listener.parts()

    async def accept_always(part: Listener[Any]) -> None:
        while True:
            try:
                await accept(part)
            except Exception as exc:
                # For example too many open files. The connections that are open must not suffer.
                logger.error("%s cannot accept connections: %s", where, exc, exc_info=exc)
                await anyio.sleep(ACCEPT_PAUSE)

    try:
        async with Background() as tasks:
            for part in parts:
                tasks.start_soon(accept_always, part)
            yield
    finally:
        with anyio.CancelScope(shield=True):
            await listener.aclose()


class HostSettings(WireSettings, frozen=True, kw_only=True):
    """The settings of a transport whose servers have a host and a port."""

    only_for_servers: ClassVar[tuple[str, ...]] = (*WireSettings.only_for_servers, "insecure")

    tls: TlsFiles | SSLContext | None = None
    """The files to make TLS from, or a context for the half that is used; in a URL the paths `ca`,
    `cert` and `key`."""
    insecure: bool = False
    """Permit a server without TLS at an address that other machines can reach."""


class HostTransport(StreamTransport):
    """A transport whose servers have a host and a port."""

    settings_type: ClassVar[type[TransportSettings]] = HostSettings
    speaks_tls: ClassVar[bytes] = SPEAKS_TLS
    """The answer of a server with TLS to a client that does not begin with TLS."""

    def __init__(self, host: str, port: int, settings: HostSettings) -> None:
        super().__init__(settings)
        if not 0 <= port <= MAX_PORT:
            raise ValueError(f"port must be between 0 and {MAX_PORT}, not {port}")
        self._host = host
        self._port = port
        self._tls = settings.tls
        self._client_tls = None if settings.tls is None else ClientTls(settings.tls)
        self._insecure = settings.insecure

    @property
    def url(self) -> str:
        """The address as a URL, without settings."""
        return self._url(self._port)

    def _url(self, port: int) -> str:
        return f"{self._scheme}://{self._netloc(port)}"

    def _netloc(self, port: int) -> str:
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"{host}:{port}"

    @property
    def _scheme(self) -> str:
        return self.tls_schemes[0] if self._tls else self.plain_scheme

    def _client_framing(self) -> Framing:
        """Return the form of the frames of a client's line."""
        return FrameReader(self.settings.max_frame)

    async def _connect(self) -> Line:
        framing, tls = self._client_framing(), self._client_tls
        if asyncio_task() is not None:
            if tls is None:
                return await on_asyncio.dial_tcp(self._host, self._port, framing, self.url)
            return await on_asyncio.dial_tls(self._host, self._port, framing, self.url, tls)
        stream = await anyio.connect_tcp(self._host, self._port)
        stream.extra(SocketAttribute.raw_socket).setsockopt(
            socket.IPPROTO_TCP, socket.TCP_NODELAY, 1
        )
        if tls is None:
            return StreamChannel(stream, self.url, framing)
        async with AsyncExitStack() as on_failure:
            on_failure.push_async_callback(anyio.aclose_forcefully, stream)
            wrapped = await TLSStream.wrap(stream, hostname=self._host, ssl_context=tls.context())
            on_failure.pop_all()
        return TlsChannel(wrapped, self.url, framing)

    async def _listen(self) -> tuple[Listener[Any], str]:
        check_is_safe(self.url, self._host, self.tls_schemes[0], self._insecure or self._tls)
        limits = self.settings.limits
        listener, port = await listen_at(
            self._host, self._port, self.url, self._tls, limits, self.speaks_tls
        )
        return listener, self._url(port)


def check_is_safe(url: str, host: str, tls_scheme: str, is_permitted: object) -> None:
    """Check that other machines can reach a host only with TLS, or if it is permitted.

    Raises:
        TransportError: They can reach it.
    """
    if not (is_permitted or is_loopback(host)):
        raise TransportError(
            f"{url} can be reached from other machines: use {tls_scheme}://, or, if the network is"
            f" your own, append ?insecure=true to the URL (in code insecure=True)"
        )


async def listen_at(
    host: str,
    port: int,
    url: str,
    tls: TlsFiles | SSLContext | None,
    limits: Limits,
    speaks_tls: bytes,
    send_buffer: int = 0,
) -> tuple[Listener[Any], int]:
    """Begin to listen, with or without TLS; return the port as well.

    `url` is for errors, and `speaks_tls` for clients that do not begin with TLS. `send_buffer` is
    the number of bytes that the system may hold for a client; 0 for its default.

    Raises:
        TransportError: Nothing can listen there, or the files of TLS cannot be used.
    """
    context = telling(tls.server()) if isinstance(tls, TlsFiles) else tls
    try:
        listener = await anyio.create_tcp_listener(local_host=host, local_port=port)
    except (OSError, UnicodeError) as exc:
        if isinstance(exc, OSError) and exc.errno == EADDRINUSE:
            raise TransportError(f"address already in use: {url}") from exc
        text = getattr(exc, "strerror", None) or exc
        raise TransportError(f"cannot listen at {url}: {text}") from exc
    port = listener.extra(SocketAttribute.local_port)
    for part in listener.listeners if send_buffer else ():
        # Those that it accepts have it, too.
        raw = part.extra(SocketAttribute.raw_socket)
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, send_buffer)
    if context is None:
        return listener, port
    shaken = TlsListener(
        listener,
        context,
        handshake_timeout=limits.handshake,
        most=limits.connections,
        speaks_tls=speaks_tls,
    )
    return shaken, port


def port_in(parts: SplitResult, default: int) -> int:
    """Return the port in a URL.

    Raises:
        ValueError: It is not a port; the text says so.
    """
    try:
        port = parts.port
    except ValueError as exc:
        raise ValueError(f"invalid port: {exc}") from exc
    return default if port is None else port


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach a host."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False

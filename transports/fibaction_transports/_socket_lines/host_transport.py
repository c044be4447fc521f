"""Connecting to a host, and listening there: by TCP, with or without TLS."""

from __future__ import annotations

import socket
from contextlib import AsyncExitStack
from errno import EADDRINUSE
from ipaddress import ip_address
from ssl import SSLContext
from typing import Any, ClassVar
from urllib.parse import SplitResult

import anyio
from anyio.abc import Listener, SocketAttribute
from anyio.streams.tls import TLSStream

from fibaction.border.event_loop import asyncio_task
from fibaction.border.settings import TransportSettings
from fibaction.wire.channel import Line, StreamChannel
from fibaction.wire.frames import FrameReader, Framing
from fibaction.wire.settings import Limits, WireSettings
from fibaction.wire.tls_files import TlsFiles
from fibaction.words.errors import TransportError
from fibaction_transports._socket_lines import on_asyncio, tls_lines
from fibaction_transports._socket_lines.stream_transport import StreamTransport
from fibaction_transports._socket_lines.tls import SPEAKS_TLS, TlsChannel, TlsListener, telling
from fibaction_transports._socket_lines.tls_lines import ClientTls

MAX_PORT = 65535
"""The largest port: a number of 16 bits."""


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
            return await tls_lines.dial_tls(self._host, self._port, framing, self.url, tls)
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

"""`tcp://host:port` and `tls://host:port`."""

from __future__ import annotations

import socket
import ssl
from contextlib import AsyncExitStack
from errno import EADDRINUSE
from ipaddress import ip_address
from typing import Any, ClassVar, Unpack
from urllib.parse import SplitResult

import anyio
from anyio.abc import Listener, SocketAttribute
from anyio.streams.tls import TLSStream

from fibaction._asyncio_task import asyncio_task
from fibaction.exceptions import TransportError
from fibaction.wire.channel import Line, StreamChannel
from fibaction.wire.frames import FrameReader
from fibaction.wire.settings import WireKeywords
from fibaction.wire.tls_files import TlsFiles
from fibaction.wire.transport import boolean, host_only
from fibaction_transports.tcp import _asyncio
from fibaction_transports.tcp._stream_transport import StreamTransport
from fibaction_transports.tcp._tls import TlsChannel, TlsListener, telling

HOST, PORT = "127.0.0.1", 7400
"""The default address: on this machine only."""
MAX_PORT = 65535
"""The largest port: a number of 16 bits."""


class TcpTransport(StreamTransport):
    """TCP, with or without TLS."""

    own_settings = ("tls", "insecure")
    own_url_settings: ClassVar = {"insecure": boolean}
    tls_schemes = ("tls",)

    def __init__(
        self,
        host: str = HOST,
        port: int = PORT,
        *,
        tls: TlsFiles | ssl.SSLContext | None = None,
        insecure: bool = False,
        **settings: Unpack[WireKeywords],
    ) -> None:
        """Take an address, and the settings of every transport over the wire protocol.

        A URL has `insecure` and the text, number and boolean settings behind its `?`. With `tls://`
        it has the paths `ca`, `cert` and `key` as well.

        Args:
            host: The host to connect to, or to listen at.
            port: The port; a server at port 0 gets a free one, which its URL shows.
            tls: The files to make TLS from, or a context for the half that is used.
            insecure: Permit a server without TLS at an address that other machines can reach.
            settings: See the table of settings.

        Raises:
            TypeError: There is no such setting.
            ValueError: A number is out of range, `orphans` is another word, or a token is not
                valid text.
        """
        super().__init__(**settings)
        if not 0 <= port <= MAX_PORT:
            raise ValueError(f"port is between 0 and {MAX_PORT}, not {port}")
        self._host = host
        self._port = port
        self._tls = tls
        self._insecure = insecure

    @classmethod
    def address_of(cls, parts: SplitResult) -> dict[str, Any]:
        """Return the host and the port in a URL."""
        host = host_only(parts) or HOST
        try:
            port = parts.port
        except ValueError as exc:
            raise ValueError(f"invalid port: {exc}") from exc
        return {"host": host, "port": PORT if port is None else port}

    @property
    def url(self) -> str:
        """The address as a URL, without settings."""
        return self._url(self._port)

    def _url(self, port: int) -> str:
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"{'tls' if self._tls else 'tcp'}://{host}:{port}"

    async def _connect(self) -> Line:
        reader = FrameReader(self.client_settings.max_frame)
        if self._tls is None and asyncio_task() is not None:
            return await _asyncio.dial_tcp(self._host, self._port, reader, self.url)
        stream = await anyio.connect_tcp(self._host, self._port)
        stream.extra(SocketAttribute.raw_socket).setsockopt(
            socket.IPPROTO_TCP, socket.TCP_NODELAY, 1
        )
        if self._tls is None:
            return StreamChannel(stream, self.url, reader)
        async with AsyncExitStack() as on_failure:
            on_failure.push_async_callback(anyio.aclose_forcefully, stream)
            given = self._tls
            context = telling(given.client()) if isinstance(given, TlsFiles) else given
            tls = await TLSStream.wrap(stream, hostname=self._host, ssl_context=context)
            on_failure.pop_all()
        return TlsChannel(tls, self.url, reader)

    async def _listen(self) -> tuple[Listener[Any], str]:
        if not (self._insecure or self._tls or _is_loopback(self._host)):
            raise TransportError(
                f"{self.url} can be reached from other machines: use tls://, or, if the network is"
                f" your own, ?insecure=true behind the URL (in code insecure=True)"
            )
        context = self._tls
        if isinstance(context, TlsFiles):
            context = telling(context.server())
        try:
            listener = await anyio.create_tcp_listener(local_host=self._host, local_port=self._port)
        except (OSError, UnicodeError) as exc:
            if isinstance(exc, OSError) and exc.errno == EADDRINUSE:
                raise TransportError(f"address already in use: {self.url}") from exc
            text = getattr(exc, "strerror", None) or exc
            raise TransportError(f"cannot listen at {self.url}: {text}") from exc
        url = self._url(listener.extra(SocketAttribute.local_port))
        if context is None:
            return listener, url
        limits = self.server_settings.limits
        tls = TlsListener(
            listener, context, handshake_timeout=limits.handshake, most=limits.connections
        )
        return tls, url


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False

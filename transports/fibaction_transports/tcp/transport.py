"""`tcp://host:port`, `tls://host:port` and `unix:///path`: actions across processes.

What is said over the connection is in `fibaction.wire`; this package opens and accepts connections.
"""

from __future__ import annotations

import logging
import math
import os
import socket
import ssl
import stat
from abc import abstractmethod
from collections.abc import AsyncGenerator, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from ipaddress import ip_address
from pathlib import Path
from typing import Any, Literal
from urllib.parse import unquote

import anyio
from anyio.abc import Listener, SocketAttribute, TaskGroup
from anyio.streams.stapled import MultiListener
from anyio.streams.tls import TLSStream

from fibaction._tasks import Background
from fibaction.abc import Connection, Endpoint, Transport
from fibaction.exceptions import (
    AuthenticationFailed,
    ConnectionLost,
    ServerNotFound,
    TransportError,
)
from fibaction.urls import without_settings
from fibaction.wire.auth import AccessPolicy, Authorize
from fibaction.wire.channel import Line, StreamChannel
from fibaction.wire.connection import ClientSettings, connected
from fibaction.wire.messages import check_can_be_sent
from fibaction.wire.session import ServerSettings
from fibaction.wire.settings import Limits
from fibaction.wire.wire_server import WireServer, hub
from fibaction_transports.tcp import _anyio, _asyncio
from fibaction_transports.tcp.settings import (
    check_has_host_only,
    settings_of,
    split,
    translated,
)
from fibaction_transports.tcp.tls import (
    TlsChannel,
    TlsFiles,
    TlsListener,
    no_tls,
)

HOST, PORT = "127.0.0.1", 7400
"""Where a server is if nothing else is said: on this machine only."""
MOST_PORT = 65535
"""A port is a number of 16 bits."""
ACCEPT_PAUSE = 0.1
"""Seconds without new connections after one could not be accepted: a lack of files passes."""

logger = logging.getLogger("fibaction.wire")


class _StreamTransport(Transport):
    """What the transports over streams of bytes have in common."""

    def __init__(
        self,
        *,
        token: str = "",
        tokens: Mapping[str, str] | None = None,
        authorize: Authorize | None = None,
        heartbeat: float = 1.0,
        reconnect: bool = True,
        reconnect_timeout: float = 30.0,
        window: int = 256,
        orphans: Literal["keep", "cancel"] = "keep",
        grace: float = 10.0,
        limits: Limits | None = None,
    ) -> None:
        """Both halves in one: each takes the settings that are its own.

        Args:
            token: What a client tells the server.
            tokens: For a server: the tokens it lets in, each with the name of whom it belongs to;
                None lets everybody in.
            authorize: For a server: called with the client, the action's name and the verb.
            heartbeat: Seconds between signs of life, both ways; who misses four is lost.
            reconnect: For a client: whether a lost connection is opened again, and goes on.
            reconnect_timeout: For a client: seconds that calls wait for that.
            window: For a client: how many feedback messages of a goal are kept until they are read.
            orphans: For a server: what becomes of the goals of a client that does not come back.
            grace: For a server: seconds that it waits for the client.
            limits: For a server: what one client may use.

        Raises:
            ValueError: A number is out of range, `orphans` is neither, or a token is no text.
        """
        check_can_be_sent(token)
        for name, value, least, most in (
            ("heartbeat", heartbeat, 0.001, 3600),
            ("window", window, 1, 2**31 - 1),
            ("reconnect_timeout", reconnect_timeout, 0, math.inf),
            ("grace", grace, 0, math.inf),
        ):
            if not least <= value <= most:
                raise ValueError(f"{name} is between {least} and {most}, not {value}")
        if orphans not in ("keep", "cancel"):
            raise ValueError(f"orphans is 'keep' or 'cancel', not {orphans!r}")
        self._keeping = ClientSettings(
            heartbeat=heartbeat,
            token=token,
            reconnect=reconnect,
            reconnect_timeout=reconnect_timeout,
            window=window,
            max_frame=(limits or Limits()).frame,
        )
        self._limits = limits or Limits()
        self._terms = ServerSettings(
            heartbeat, AccessPolicy(tokens, authorize), self._limits, orphans, grace
        )

    @asynccontextmanager
    async def serve(self, *endpoints: Endpoint) -> AsyncGenerator[str, None]:
        """See `Transport.serve`. With port 0, the URL tells which port it became."""
        served = {endpoint.info.name: endpoint for endpoint in endpoints}
        if len(served) < len(endpoints):
            raise TransportError("two of the endpoints serve actions of the same name")
        async with hub(served, self._terms) as (connections, tasks):
            listener, url = await self._listen()
            try:
                async with Background() as accepting:
                    parts: Sequence[Listener[Any]] = [listener]
                    if isinstance(listener, MultiListener):  # a host with several addresses
                        parts = listener.listeners
                    for one in parts:
                        accepting.start_soon(self._accept, one, connections, tasks)
                    yield url
            finally:
                self._forget()
                with anyio.CancelScope(shield=True):
                    await listener.aclose()

    @asynccontextmanager
    async def connect(self) -> AsyncGenerator[Connection, None]:
        """See `Transport.connect`."""
        async with connected(self._dial, self._where, self._keeping) as connection:
            yield connection

    @property
    @abstractmethod
    def _where(self) -> str:
        """The URL, without anything secret."""

    @abstractmethod
    async def _open(self) -> Line:
        """Connect."""

    @abstractmethod
    async def _listen(self) -> tuple[Listener[Any], str]:
        """Begin to listen; gives the URL, too."""

    def _forget(self) -> None:
        """Nobody is to connect any more, though somebody still listens."""

    async def _dial(self) -> Line:
        try:
            return await self._open()
        except ssl.SSLError as exc:
            raise AuthenticationFailed(no_tls(self._where, exc)) from exc
        except OSError as exc:
            raise ServerNotFound(
                f"nobody listens at {self._where} ({exc.strerror or exc}): start the server, or"
                f" wait for it with wait_for_server()"
            ) from exc
        except UnicodeError as exc:
            raise ServerNotFound(f"nobody can be at {self._where}: {exc}") from exc
        except (anyio.BrokenResourceError, anyio.EndOfStream) as exc:
            raise ConnectionLost(f"{self._where} closed the connection at once") from exc

    async def _accept(
        self, listener: Listener[Any], connections: WireServer, tasks: TaskGroup
    ) -> None:
        plain = _asyncio.on_asyncio() and not isinstance(listener, TlsListener)
        accept = _asyncio.accept if plain else _anyio.accept
        while True:
            try:
                await accept(listener, self._limits.frame, connections.serve, tasks)
            except Exception as exc:
                # For instance too many open files. Those who are connected must not suffer.
                logger.error("%s cannot accept connections: %s", self._where, exc, exc_info=exc)
                await anyio.sleep(ACCEPT_PAUSE)


class TcpTransport(_StreamTransport):
    """TCP, with or without TLS."""

    def __init__(
        self,
        host: str = HOST,
        port: int = PORT,
        *,
        tls: TlsFiles | ssl.SSLContext | None = None,
        insecure: bool = False,
        **settings: Any,
    ) -> None:
        """Take an address, and the settings that all transports over streams have.

        `tls` is a context of one's own, for the half that is used, or says which files to make it
        from. A server at an address that others than this machine can reach must have TLS, or
        `insecure`.

        Raises:
            ValueError: A number is out of range, `orphans` is neither, or a token is no text.
        """
        super().__init__(**settings)
        if not 0 <= port <= MOST_PORT:
            raise ValueError(f"port is between 0 and {MOST_PORT}, not {port}")
        self._host = host
        self._port = port
        self._tls = tls
        self._insecure = insecure

    @classmethod
    def from_url(cls, url: str, **settings: Any) -> TcpTransport:
        """Make it from `tcp://host:port` or `tls://host:port`.

        Behind `?`: `token`, `heartbeat`, `reconnect`, `reconnect_timeout`, `window`, `orphans`,
        `grace`, `insecure`, and for TLS `ca`, `cert` and `key`, which are paths of PEM files; a
        server that is given a `ca` asks its clients for certificates.

        Raises:
            TransportError: The URL is another one.
            TypeError: There is no such setting.
        """
        parts, query = split(url)
        check_has_host_only(url, parts)
        try:
            host, port = parts.hostname or HOST, PORT if parts.port is None else parts.port
        except ValueError as exc:
            raise TransportError(f"{without_settings(url)} has no good port: {exc}") from exc
        files_of = {"ca", "cert", "key"} if parts.scheme == "tls" else set[str]()
        found = settings_of(url, query, {"insecure"} | files_of)
        files = {name: found.pop(name, None) for name in ("ca", "cert", "key")}
        tls = TlsFiles(**files) if parts.scheme == "tls" else None
        made: dict[str, Any] = {"tls": tls, **found, **settings}
        with translated(url):
            return cls(host, port, **made)

    @property
    def _where(self) -> str:
        return self._url(self._port)

    def _url(self, port: int) -> str:
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"{'tls' if self._tls else 'tcp'}://{host}:{port}"

    async def _open(self) -> Line:
        max_frame = self._limits.frame
        if self._tls is None and _asyncio.on_asyncio():
            return await _asyncio.dial_tcp(self._host, self._port, max_frame, self._where)
        stream = await anyio.connect_tcp(self._host, self._port)
        stream.extra(SocketAttribute.raw_socket).setsockopt(
            socket.IPPROTO_TCP, socket.TCP_NODELAY, 1
        )
        if self._tls is None:
            return StreamChannel(stream, self._where, max_frame)
        async with AsyncExitStack() as on_failure:
            on_failure.push_async_callback(anyio.aclose_forcefully, stream)
            context = self._tls.client() if isinstance(self._tls, TlsFiles) else self._tls
            tls = await TLSStream.wrap(stream, hostname=self._host, ssl_context=context)
            on_failure.pop_all()
        return TlsChannel(tls, self._where, max_frame)

    async def _listen(self) -> tuple[Listener[Any], str]:
        if not (self._insecure or self._tls or _is_loopback(self._host)):
            raise TransportError(
                f"{self._where} can be reached from other machines: use tls://, or say"
                f" insecure=True if the network is your own"
            )
        context = self._tls.server() if isinstance(self._tls, TlsFiles) else self._tls
        try:
            listener = await anyio.create_tcp_listener(local_host=self._host, local_port=self._port)
        except OSError as exc:
            raise TransportError(f"cannot listen at {self._where}: {exc.strerror or exc}") from exc
        except UnicodeError as exc:
            raise TransportError(f"cannot listen at {self._where}: {exc}") from exc
        port = listener.extra(SocketAttribute.local_port)
        if context is None:
            return listener, self._url(port)
        timeout = self._limits.handshake
        return TlsListener(listener, context, handshake_timeout=timeout), self._url(port)


class UnixTransport(_StreamTransport):
    """A Unix domain socket: processes of one machine, with the permissions of a file."""

    def __init__(self, path: str | os.PathLike[str], **settings: Any) -> None:
        """Take the socket's path, and the settings that all transports over streams have.

        Raises:
            ValueError: As for TCP.
        """
        super().__init__(**settings)
        self._path = Path(path)
        self._socket: tuple[int, int] | None = None  # the file that we listen at

    @classmethod
    def from_url(cls, url: str, **settings: Any) -> UnixTransport:
        """Make it from `unix:///path`, with the same settings behind `?` as TCP.

        Raises:
            TransportError: The URL is another one.
            TypeError: There is no such setting.
        """
        parts, query = split(url)
        path = unquote(parts.path)
        if parts.netloc or len(path) < 2 or "\0" in path:
            where = without_settings(url)
            raise TransportError(f"the URL of a socket is like unix:///run/robot.sock, not {where}")
        with translated(url):
            return cls(path, **{**settings_of(url, query, set()), **settings})

    @property
    def _where(self) -> str:
        return f"unix://{self._path}"

    async def _open(self) -> Line:
        max_frame = self._limits.frame
        if _asyncio.on_asyncio():
            return await _asyncio.dial_unix(self._path, max_frame, self._where)
        return StreamChannel(await anyio.connect_unix(self._path), self._where, max_frame)

    async def _listen(self) -> tuple[Listener[Any], str]:
        if await self._is_served():
            raise TransportError(f"cannot listen at {self._where}: somebody does already")
        try:
            listener = await anyio.create_unix_listener(self._path, mode=0o600)
        except (OSError, ValueError) as exc:
            raise TransportError(f"cannot listen at {self._where}: {exc}") from exc
        self._socket = _identity(self._path)
        return listener, self._where

    async def _is_served(self) -> bool:
        """Whether a server has the socket: a file that one has left behind is only in the way."""
        try:
            if not stat.S_ISSOCK(self._path.stat().st_mode):
                return False
            await (await anyio.connect_unix(self._path)).aclose()
        except OSError:
            return False
        return True

    def _forget(self) -> None:
        # It may have been removed, and be another server's by now. As long as we listen, no other
        # file is given the number of ours.
        if _identity(self._path) == self._socket:
            self._path.unlink(missing_ok=True)


def _identity(path: Path) -> tuple[int, int] | None:
    """Which file that is, whatever it is called; None if there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False

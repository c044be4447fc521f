"""`Dialer`: connects to one broker, with TLS and the login of the settings.

Theory of operation
-------------------

The first line of a broker is read without TLS, and TLS begins after it. A broker that is configured
for `handshake_first` says nothing before TLS: so with `nats+tls://`, TLS begins as well when a
broker is silent for `SILENCE`. The line before TLS may come from an attacker between the two ends.
So nothing but that one line is taken from there, a broker that then has no TLS gets no login, and
more than that one line ends the connection.

The connection belongs to `LoginLines` until the login is done, and to a `BrokerSocket` then.
"""

from __future__ import annotations

import asyncio  # noqa: TID251  # connections change their protocol here, which anyio's cannot
import ipaddress
import ssl
from collections.abc import Callable
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

import anyio
import anyio.lowlevel

from fibaction.border.abc import Notifier
from fibaction.border.event_loop import asyncio_loop
from fibaction.wire.transport import TlsFiles
from fibaction.words.errors import AuthenticationFailed, ServerNotFound, TransportError
from fibaction_transports._socket_lines.tls import rejection, tls_reason
from fibaction_transports.nats.broker.broker import Message
from fibaction_transports.nats.broker.broker_socket import CRLF, LONGEST_LINE, BrokerSocket
from fibaction_transports.nats.broker.login import (
    BrokerInfo,
    NatsCredentials,
    connect_command,
    info_of,
    is_let_in,
)
from fibaction_transports.nats.settings import FleetSettings

DIAL_TIMEOUT = 2.0
"""Seconds that one broker has to let this client in."""
SILENCE = 0.5
"""Seconds without a word after which a broker is taken to want TLS first."""


class Dialer:
    """Connects to brokers with the login and the TLS of the settings."""

    def __init__(
        self,
        settings: FleetSettings,
        deliver: Callable[[int, Message], None],
        on_change: Callable[[], None],
    ) -> None:
        """Give these functions to each `BrokerSocket`."""
        self._settings = settings
        self._deliver = deliver
        self._on_change = on_change
        self._tls: ssl.SSLContext | None = None
        self._tls_first: set[str] = set()
        """The brokers that wanted TLS before their first line."""
        self._host = ""
        """The name of a broker of the settings. The others of its cluster may tell addresses only,
        which are in no certificate."""

    def read_files(self) -> None:
        """Read the files of the settings.

        Raises:
            TransportError: They cannot be used.
        """
        self._credentials()
        tls = self._settings.tls
        self._tls = tls.client() if isinstance(tls, TlsFiles) else tls

    def _credentials(self) -> NatsCredentials | None:
        """Read the credentials file, which may be another one for each connection."""
        return NatsCredentials.read(self._settings.creds) if self._settings.creds else None

    async def dial(self, server: str) -> BrokerSocket:
        """Connect to a broker.

        Raises:
            ServerNotFound: It does not answer.
            AuthenticationFailed: It does not let this client in.
            TransportError: It reports another error, or the credentials file cannot be used.
        """
        asyncio_loop()  # in whose name messages are handled, later on
        lines = LoginLines()
        try:
            with anyio.fail_after(DIAL_TIMEOUT):
                info = await self._log_in(lines, server)
            if lines.is_lost:
                raise ServerNotFound(f"the broker {server} has closed the connection")
        except BaseException as exc:
            await lines.cut()
            if isinstance(exc, OSError | ValueError):
                raise _translated(server, exc) from exc
            raise
        socket = BrokerSocket(lines.transport, info, self._deliver, self._on_change)
        socket.begin(lines.rest)
        return socket

    async def _log_in(self, lines: LoginLines, server: str) -> BrokerInfo:
        """Connect and log in.

        Raises:
            OSError: The connection or TLS fails.
            ValueError: It is not a broker, or its name is not that of a host.
            TransportError: It does not let this client in.
        """
        parts = urlsplit(f"//{server}")
        host = parts.hostname or ""
        loop = asyncio.get_running_loop()
        await loop.create_connection(lambda: lines, host, parts.port or 0)
        is_known = server in self._settings.servers
        name = host if is_known or not _is_address(host) else self._host or host
        info = await self._secured(lines, server, name)
        command = connect_command(self._settings, self._credentials(), info)
        lines.transport.write(command)
        while not is_let_in(server, await lines.next()):
            pass
        if is_known:
            self._host = host
        return info

    async def _secured(self, lines: LoginLines, server: str, name: str) -> BrokerInfo:
        """Read the first line, and begin TLS with the host of that name if it is wanted.

        Raises:
            OSError: The connection or TLS fails.
            ValueError: It is not a broker.
            AuthenticationFailed: The settings want TLS, and the broker has none.
        """
        if self._tls is not None and await self._wants_tls_first(lines, server):
            await lines.start_tls(self._tls, name)
            info = info_of(await lines.next())
            self._tls_first.add(server)
            return info
        info = info_of(await lines.next())
        context = self._context(server, info)
        if context is not None:
            await lines.start_tls(context, name)
        return info

    async def _wants_tls_first(self, lines: LoginLines, server: str) -> bool:
        """Return whether a broker says nothing before TLS, as it did last time or does now."""
        if server in self._tls_first:
            self._tls_first.remove(server)  # until it does so again
            return True
        with anyio.move_on_after(SILENCE) as waiting:
            await lines.ready()
        return waiting.cancelled_caught

    def _context(self, server: str, info: BrokerInfo) -> ssl.SSLContext | None:
        """Return the TLS that begins after the first line of a broker; None for none.

        Raises:
            AuthenticationFailed: The settings want TLS, and the broker has none.
        """
        if self._tls is None:
            return ssl.create_default_context() if info.tls_required else None
        if not (info.tls_required or info.tls_available):
            raise AuthenticationFailed(
                f"broker {server}: the broker has no TLS: use nats:// if the network is your own"
            )
        return self._tls


class LoginLines(asyncio.Protocol):
    """The lines that a broker sends during the login."""

    def __init__(self) -> None:
        self.transport: Any = None
        self.rest = b""
        """The bytes after the lines that were read."""
        self._failure: Exception | None = None  # of the connection
        self._changed = Notifier()

    @property
    def is_lost(self) -> bool:
        """True if the connection is closed, or is being closed."""
        return self._failure is not None or self.transport.is_closing()

    async def ready(self) -> None:
        """Wait until a line is there.

        Raises:
            OSError: The connection is lost.
            ValueError: The line is too long.
        """
        while CRLF not in self.rest:
            if self._failure is not None:
                raise self._failure
            if len(self.rest) > LONGEST_LINE:
                raise ValueError("a line is too long")
            await self._changed.wait()

    async def next(self) -> bytes:
        """Return the next line.

        Raises:
            OSError: The connection is lost.
            ValueError: The line is too long.
        """
        await self.ready()
        line, _, self.rest = self.rest.partition(CRLF)
        return line

    async def start_tls(self, context: ssl.SSLContext, name: str) -> None:
        """Begin TLS with the host of that name.

        Raises:
            OSError: TLS fails.
            ValueError: The broker has said more before TLS than it may.
        """
        if self.rest:
            raise ValueError("more than one line before TLS")
        loop = asyncio.get_running_loop()
        made = await loop.start_tls(self.transport, self, context, server_hostname=name)
        if made is None:  # lost as soon as it was made
            raise ConnectionResetError
        self.transport = made

    async def cut(self) -> None:
        """Close the connection at once, if there is one."""
        if self.transport is not None:
            self.transport.abort()
            with anyio.CancelScope(shield=True):
                await anyio.lowlevel.checkpoint()  # in which the socket is closed

    # Called by the event loop

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport

    def data_received(self, data: bytes) -> None:
        self.rest += data
        self._changed.notify()

    def connection_lost(self, exc: Exception | None) -> None:
        self._failure = exc or ConnectionResetError()
        self._changed.notify()


def _is_address(host: str) -> bool:
    with suppress(ValueError):
        ipaddress.ip_address(host)
        return True
    return False


def _translated(server: str, error: OSError | ValueError) -> TransportError:
    """Return the error of a failed attempt to connect, in one sentence."""
    if isinstance(error, ssl.SSLError):
        why = rejection("it", error) or tls_reason(error)
        return AuthenticationFailed(f"no TLS with the broker {server}: {why}")
    if isinstance(error, TimeoutError):
        return ServerNotFound(f"the broker {server} did not answer in {DIAL_TIMEOUT:g} s")
    if isinstance(error, UnicodeError):
        return ServerNotFound(f"no broker at {server}: it is not the name of a host")
    if isinstance(error, OSError) and not isinstance(error, ConnectionError) and error.strerror:
        return ServerNotFound(f"no broker at {server}: {error.strerror}")
    return ServerNotFound(
        f"no broker of NATS answers at {server}: start one, for example with 'fibaction broker'"
    )

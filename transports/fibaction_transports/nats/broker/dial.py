"""Connecting to one broker by nats-py, which has its connection taken away after the login."""

from __future__ import annotations

import asyncio  # noqa: TID251  # nats-py is for asyncio only
import ssl
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import anyio
import nats.errors
from nats.aio.client import Client

from fibaction._runtime.asyncio_task import asyncio_loop
from fibaction._runtime.log import clean_logger
from fibaction.wire.tls_files import TlsFiles
from fibaction.words.errors import AuthenticationFailed, ServerNotFound, TransportError
from fibaction_transports.nats.broker.answers import RawMessage
from fibaction_transports.nats.broker.broker_socket import CUT_TIMEOUT, BrokerSocket
from fibaction_transports.nats.settings import FleetSettings

DIAL_TIMEOUT = 2
"""Seconds that one broker has to let this client in."""
NO_TLS = "the broker has no TLS: use nats:// if the network is your own"

logger = clean_logger("fibaction.nats")


class Dialer:
    """Connects to brokers with the login and the TLS of the settings."""

    def __init__(
        self,
        settings: FleetSettings,
        deliver: Callable[[int, RawMessage], None],
        on_change: Callable[[], None],
    ) -> None:
        """Give these functions to each `BrokerSocket`."""
        self._settings = settings
        self._deliver = deliver
        self._on_change = on_change
        self._tls: ssl.SSLContext | None = None

    def read_files(self) -> None:
        """Read the files of the settings.

        Raises:
            TransportError: They cannot be used.
        """
        creds, tls = self._settings.creds, self._settings.tls
        if creds:
            try:
                Path(creds).read_bytes()
            except OSError as exc:
                raise TransportError(
                    f"the credentials file {creds} cannot be read: {exc.strerror}"
                ) from exc
        self._tls = tls.client() if isinstance(tls, TlsFiles) else tls

    async def dial(self, server: str) -> BrokerSocket:
        """Connect to a broker.

        Raises:
            ServerNotFound: It does not answer.
            AuthenticationFailed: It does not let this client in.
        """
        asyncio_loop()  # in whose name messages are handled, later on
        errors: list[Exception] = []
        client: Any = Client()
        task = asyncio.ensure_future(self._handshake(client, server, errors))
        try:
            await asyncio.wait({task}, timeout=DIAL_TIMEOUT)
            if not task.done():
                raise ServerNotFound(f"the broker {server} did not answer in {DIAL_TIMEOUT} s")
            if error := task.exception():
                raise _translated(server, [error, *errors]) from error
            return await self._take_over(client, server)
        except BaseException:
            await cut(client, task)
            raise

    async def _take_over(self, client: Any, server: str) -> BrokerSocket:
        """Take the connection from nats-py, with what it has read, and end its tasks."""
        reader, transport = client._transport._io_reader, client._transport._io_writer.transport
        if transport.is_closing() or reader.at_eof():
            raise ServerNotFound(f"the broker {server} has closed the connection")
        socket = BrokerSocket(
            transport, client._server_info, self._deliver, self._on_change, client
        )
        socket.begin(bytes(client._ps.buf + reader._buffer))
        await _end(tasks_of(client))
        return socket

    async def _handshake(self, client: Client, server: str, errors: list[Exception]) -> None:
        """Connect and log in."""
        settings = self._settings

        async def on_error(error: Exception) -> None:
            errors.append(error)
            del errors[4:]
            logger.debug("%s: %s", server, error)

        login: dict[str, Any] = {}
        if settings.user or settings.password:
            login["user"] = partial(self._secret, client, settings.user)
            login["password"] = settings.password
        else:
            if settings.login_token or self._tls is not None:
                login["token"] = partial(self._secret, client, settings.login_token)
            if settings.creds:
                login["user_credentials"] = settings.creds
        await client.connect(
            [f"nats://{server}"],
            error_cb=on_error,
            name="fibaction",
            allow_reconnect=False,
            connect_timeout=DIAL_TIMEOUT,
            reconnect_time_wait=0,
            max_reconnect_attempts=1,
            tls=self._tls,
            **login,
        )

    def _secret(self, client: Any, secret: str) -> str:
        """Return a part of the login, if the connection has TLS or need not have it.

        nats-py asks for it when the broker has said whether it has TLS.
        """
        if self._tls is not None and not client._server_info.get("tls_required"):
            raise nats.errors.Error(NO_TLS)
        return secret


def tasks_of(client: Any) -> list[asyncio.Task[Any]]:
    """Return the tasks of nats-py, of which it has no list."""
    tasks = [client._reading_task, client._ping_interval_task, client._flusher_task]
    return [task for task in tasks if task is not None]


async def cut(client: Any, *tasks: asyncio.Task[Any]) -> None:
    """Close a connection of nats-py at once, and end its tasks."""
    stream = getattr(client._transport, "_io_writer", None)
    if stream is not None:
        stream.transport.abort()
    await _end([*tasks, *tasks_of(client)])


async def _end(tasks: list[asyncio.Task[Any]]) -> None:
    """Cancel tasks, and wait until they have ended."""
    for task in tasks:
        task.cancel()
    with anyio.CancelScope(shield=True):
        if tasks:
            await asyncio.wait(tasks, timeout=CUT_TIMEOUT)
        await anyio.lowlevel.checkpoint()  # in which a socket is closed
    for task in tasks:
        if task.done() and not task.cancelled():
            task.exception()  # asked for, so that asyncio does not log it


def _translated(server: str, errors: list[BaseException | Exception]) -> TransportError:
    """Return the error of a failed attempt to connect, in one sentence."""
    texts = [str(error) for error in errors]
    for error, text in zip(errors, texts, strict=True):
        if isinstance(error, ModuleNotFoundError):
            return TransportError(
                f"credentials files need the package {error.name!r}: install fibaction[nats]"
            )
        if isinstance(error, ssl.SSLError):
            return AuthenticationFailed(f"no TLS with the broker {server}: {error}")
        if text == NO_TLS:
            return AuthenticationFailed(f"broker {server}: {text}")
        if "uthorization" in text or "uthentication" in text:
            return AuthenticationFailed(
                f"the broker {server} rejects the login: give user:password@ or token@ in front of"
                f" the host, or creds="
            )
    for error in errors:
        if isinstance(error, OSError) and not isinstance(error, ConnectionError):
            return ServerNotFound(f"no broker at {server}: {error.strerror or error}")
    return ServerNotFound(
        f"no broker of NATS answers at {server}: start one, for example with 'fibaction broker'"
    )

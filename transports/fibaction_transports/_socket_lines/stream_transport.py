"""Opening and accepting streams of bytes, as TCP and Unix sockets have in common."""

from __future__ import annotations

import ssl
from abc import abstractmethod
from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import anyio
from anyio.abc import Listener
from anyio.streams.stapled import MultiListener

from fibaction.border.event_loop import Background, asyncio_task
from fibaction.border.peer_text import clean_logger
from fibaction.wire.channel import Line
from fibaction.wire.frames import Framing
from fibaction.wire.transport import WireTransport
from fibaction.words.errors import (
    AuthenticationFailed,
    ConnectionLost,
    InvalidURL,
    ServerNotFound,
)
from fibaction_transports._socket_lines import on_anyio, on_asyncio, tls_lines
from fibaction_transports._socket_lines.tls import TlsListener, no_tls

if TYPE_CHECKING:
    from fibaction.wire.wire_server import WireServer

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
            await on_anyio.accept(listener, new_framing, server.serve, server.tasks)
        elif isinstance(listener, TlsListener):
            await tls_lines.accept_tls(listener, new_framing, server.serve, server.tasks)
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

"""Sockets on asyncio as lines, with and without TLS: to dial a server, and to serve its clients.

`protocol_line` has the lines, and `tls` the frames inside TLS. `ClientTls` is the TLS of a
client from one connection to the next.
"""

from __future__ import annotations

import asyncio  # noqa: TID251  # this module is for asyncio only
import os
import socket
import ssl
from collections.abc import Callable, Coroutine
from ipaddress import ip_address
from typing import Any

from anyio.abc import Listener, TaskGroup

from fibaction.border.event_loop import asyncio_loop
from fibaction.border.peer_text import clean_logger
from fibaction.wire.channel import CHUNK, Line
from fibaction.wire.frames import FrameReader, Framing
from fibaction.wire.transport import TlsFiles
from fibaction_transports._socket_lines.protocol_line import LineTurns, ProtocolLine
from fibaction_transports._socket_lines.sockets import SocketStream, accept_sockets, peer_of
from fibaction_transports._socket_lines.tls import (
    TlsEnd,
    TlsFraming,
    TlsListener,
    shake_hands,
    telling,
)

NEXT_ADDRESS = 0.25
"""Seconds after which a host is tried at its next address, too: as RFC 8305 recommends."""


FileStamp = tuple[int, int, int]
"""The version of a file: the time of its last change, its size and its number."""

logger = clean_logger("fibaction.wire")


async def dial_tcp(host: str, port: int, framing: Framing, where: str) -> ProtocolLine:
    """Connect to a server.

    Raises:
        OSError: The server does not answer.
    """
    loop = asyncio_loop()
    settings: dict[str, Any] = {}
    # Other loops, such as uvloop, try one address after the other. asyncio has to do so where tasks
    # begin at once, as in programs of Textual: before Python 3.12.8 and 3.13.1 it fails with an
    # AssertionError otherwise (https://github.com/python/cpython/issues/124309). And where there is
    # one address only, since a dial of several that is canceled may leave a socket open.
    is_eager = not isinstance(loop, asyncio.BaseEventLoop) or loop.get_task_factory() is not None
    if not (is_eager or _is_address(host)):
        settings["happy_eyeballs_delay"] = NEXT_ADDRESS
    made = await loop.create_connection(
        lambda: ProtocolLine(framing, _buffer(), where), host, port, **settings
    )
    return made[1]


def _is_address(host: str) -> bool:
    try:
        ip_address(host)
    except ValueError:
        return False
    return True


async def dial_unix(path: os.PathLike[str], framing: Framing, where: str) -> ProtocolLine:
    """Connect to a server.

    Raises:
        OSError: The server does not answer.
    """
    made = await asyncio_loop().create_unix_connection(
        lambda: ProtocolLine(framing, _buffer(), where), os.fspath(path)
    )
    return made[1]


class LineMaker:
    """Makes lines of the sockets of one listener, which share their turns and one buffer."""

    def __init__(self) -> None:
        self._buffer = _buffer()
        self._turns = LineTurns()

    async def make(self, accepted: socket.socket, framing: Framing, early: bytes = b"") -> Line:
        """Return the line over a socket, which it owns from now on.

        Raises:
            OSError: The connection was lost meanwhile.
        """
        try:
            made = await asyncio_loop().connect_accepted_socket(
                lambda: ProtocolLine(framing, self._buffer, turns=self._turns, early=early),
                accepted,
            )
        except BaseException:
            accepted.close()
            raise
        return made[1]


async def accept(
    listener: Listener[Any],
    new_framing: Callable[[], Framing],
    serve: Callable[[Line], Coroutine[Any, Any, None]],
    tasks: TaskGroup,
) -> None:
    """Serve the line of each client that connects in a task of its own, until accepting fails.

    Raises:
        OSError: A connection could not be accepted.
    """
    lines = LineMaker()

    async def begin(accepted: socket.socket) -> None:
        await serve_socket(accepted, lines, new_framing(), serve)

    await accept_sockets(listener, begin, tasks)


async def serve_socket(
    accepted: socket.socket,
    lines: LineMaker,
    framing: Framing,
    serve: Callable[[Line], Coroutine[Any, Any, None]],
    early: bytes = b"",
) -> None:
    """Serve the line over a socket, unless the connection was lost meanwhile."""
    try:
        line = await lines.make(accepted, framing, early)
    except Exception as exc:
        logger.warning("a connection was lost as it was accepted: %s", exc)
    else:
        await serve(line)


def _buffer() -> memoryview:
    return memoryview(bytearray(CHUNK))


# With TLS


class ClientTls:
    """The TLS of a client to one host: its context, and the session that is resumed next.

    The handshake of a session that is resumed has no certificates and no signatures, which are most
    of its cost for both ends. A server that does not know the session, for example because it was
    restarted, shakes hands as with a new client.
    """

    def __init__(self, given: TlsFiles | ssl.SSLContext) -> None:
        self._files = given if isinstance(given, TlsFiles) else None
        self._context = given if isinstance(given, ssl.SSLContext) else None
        self._stamps: list[FileStamp] = []
        self._last: ssl.SSLObject | None = None

    def context(self) -> ssl.SSLContext:
        """Return the context. It is made again, without a session, when a file has changed.

        Raises:
            TransportError: The files cannot be used.
        """
        if self._files is not None:
            stamps = _stamps_of(self._files)
            if self._context is None or stamps != self._stamps:
                self._context, self._last = telling(self._files.client()), None
                self._stamps = stamps
        assert self._context is not None
        return self._context

    def begin(self, host: str) -> TlsEnd:
        """Return the end of a new connection, before its handshake.

        Raises:
            TransportError: The files cannot be used.
        """
        context = self.context()
        # Read only now: a server of TLS 1.3 sends the session after the handshake.
        session = None if self._last is None else self._last.session
        return TlsEnd(context, host, session)

    def keep(self, end: TlsEnd) -> None:
        """Let the next connection resume the session of this one, which has shaken hands.

        If a file has changed meanwhile, the session is not kept.
        """
        if end.tls.context is self._context:
            self._last = end.tls

    def forget(self) -> None:
        """Begin a new session with the next connection."""
        self._last = None


def _stamps_of(files: TlsFiles) -> list[FileStamp]:
    stamps: list[FileStamp] = []
    for name in (files.ca, files.cert, files.key):
        try:
            found = os.stat(name) if name is not None else None
        except (OSError, ValueError):  # the error of reading the file says more
            found = None
        stamps.append(
            (0, 0, 0) if found is None else (found.st_mtime_ns, found.st_size, found.st_ino)
        )
    return stamps


async def dial_tls(host: str, port: int, framing: Framing, where: str, tls: ClientTls) -> Line:
    """Connect to a server, and shake hands.

    Raises:
        TransportError: The files for TLS cannot be used.
        ssl.SSLError: The server does not speak TLS, or one side rejects the other.
        OSError, anyio.BrokenResourceError: The server does not answer, or has closed.
    """
    end = tls.begin(host)
    # The line gets the form of its frames after the handshake.
    line = await dial_tcp(host, port, FrameReader(), where)
    try:
        early = await shake_hands(end, line.receive_bytes, line.send_bytes)
    except BaseException:
        tls.forget()  # the session may be at fault
        await line.aclose()
        raise
    tls.keep(end)
    line.begin(TlsFraming(framing, end, where), early)
    return line


async def accept_tls(
    listener: TlsListener,
    new_framing: Callable[[], Framing],
    serve: Callable[[Line], Coroutine[Any, Any, None]],
    tasks: TaskGroup,
) -> None:
    """Serve the line of each client that connects and shakes hands in a task of its own, until
    accepting fails.

    Raises:
        OSError: A connection could not be accepted.
    """
    lines = LineMaker()

    async def begin(accepted: socket.socket) -> None:
        stream = SocketStream(accepted)
        end = TlsEnd(listener.ssl_context)
        peer = peer_of(stream)

        async def begin_line(early: bytes) -> None:
            framing = TlsFraming(new_framing(), end, peer)
            await serve_socket(stream.detach(), lines, framing, serve, early)

        await listener.shake_hands(
            stream, lambda: shake_hands(end, stream.receive, stream.send), begin_line
        )

    await accept_sockets(listener.listener, begin, tasks)

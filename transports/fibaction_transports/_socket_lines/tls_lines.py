"""Lines with TLS on asyncio: the lines of `on_asyncio`, whose frames are inside TLS; and the TLS of
a client from one connection to the next.
"""

from __future__ import annotations

import os
import socket
import ssl
from collections.abc import Callable, Coroutine
from typing import Any

from anyio.abc import TaskGroup

from fibaction.wire.channel import Line
from fibaction.wire.frames import FrameReader, Framing
from fibaction.wire.tls_files import TlsFiles
from fibaction_transports._socket_lines import on_asyncio
from fibaction_transports._socket_lines.on_anyio import peer_of
from fibaction_transports._socket_lines.sockets import SocketStream, accept_sockets
from fibaction_transports._socket_lines.tls import TlsListener, telling
from fibaction_transports._socket_lines.tls_frames import TlsEnd, TlsFraming, shake_hands

FileStamp = tuple[int, int, int]
"""The version of a file: the time of its last change, its size and its number."""


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
    line = await on_asyncio.dial_tcp(host, port, FrameReader(), where)
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
    lines = on_asyncio.LineMaker()

    async def begin(accepted: socket.socket) -> None:
        stream = SocketStream(accepted)
        end = TlsEnd(listener.ssl_context)
        peer = peer_of(stream)

        async def begin_line(early: bytes) -> None:
            framing = TlsFraming(new_framing(), end, peer)
            await on_asyncio.serve_socket(stream.detach(), lines, framing, serve, early)

        await listener.shake_hands(
            stream, lambda: shake_hands(end, stream.receive, stream.send), begin_line
        )

    await accept_sockets(listener.listener, begin, tasks)

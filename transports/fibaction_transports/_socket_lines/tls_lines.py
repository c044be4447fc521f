"""Lines with TLS on asyncio: the lines of `on_asyncio`, whose frames are inside TLS."""

from __future__ import annotations

import socket
from collections.abc import Callable, Coroutine
from typing import Any

from anyio.abc import TaskGroup

from fibaction.wire.channel import Line
from fibaction.wire.frames import FrameReader, Framing
from fibaction_transports._socket_lines import on_asyncio
from fibaction_transports._socket_lines.client_tls import ClientTls
from fibaction_transports._socket_lines.on_anyio import peer_of
from fibaction_transports._socket_lines.sockets import SocketStream, accept_sockets
from fibaction_transports._socket_lines.tls import TlsListener
from fibaction_transports._socket_lines.tls_frames import TlsEnd, TlsFraming, shake_hands


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

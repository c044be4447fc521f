"""Sockets on asyncio as lines: to dial a server, and to serve those who connect.

`protocol_line` has the lines, and `tls_lines` adds TLS.
"""

from __future__ import annotations

import asyncio  # noqa: TID251  # this module is for asyncio only
import os
import socket
from collections.abc import Callable, Coroutine
from ipaddress import ip_address
from typing import Any

from anyio.abc import Listener, TaskGroup

from fibaction.border.event_loop import asyncio_loop
from fibaction.border.peer_text import clean_logger
from fibaction.wire.channel import CHUNK, Line
from fibaction.wire.frames import Framing
from fibaction_transports._socket_lines.protocol_line import LineTurns, ProtocolLine
from fibaction_transports._socket_lines.sockets import accept_sockets

NEXT_ADDRESS = 0.25
"""Seconds after which a host is tried at its next address, too: as RFC 8305 recommends."""


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

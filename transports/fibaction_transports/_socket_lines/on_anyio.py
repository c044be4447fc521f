"""Connections over the streams of anyio: on every backend, and with TLS."""

from __future__ import annotations

import socket
from collections.abc import Callable, Coroutine
from contextlib import suppress
from functools import partial
from typing import Any

import anyio
from anyio.abc import AnyByteStream, ByteStream, Listener, SocketAttribute, TaskGroup

from fibaction.wire.channel import CHUNK, LEAVE, Line, StreamChannel
from fibaction.wire.frames import Framing
from fibaction_transports._socket_lines.sockets import serve_alone

BROKEN = (OSError, anyio.BrokenResourceError, anyio.ClosedResourceError, anyio.EndOfStream)
"""The errors of a stream whose peer has gone."""


async def accept(
    listener: Listener[Any],
    new_framing: Callable[[], Framing],
    serve: Callable[[Line], Coroutine[Any, Any, None]],
    tasks: TaskGroup,
) -> None:
    """Serve each client that connects in a task of its own, until accepting fails.

    Raises:
        OSError: A connection could not be accepted.
    """

    async def begin(stream: ByteStream) -> None:
        await serve(StreamChannel(stream, peer_of(stream), new_framing()))

    await listener.serve(partial(serve_alone, begin), tasks)


def peer_of(stream: AnyByteStream) -> str:
    """Return the address of the peer, for logs."""
    family = stream.extra(SocketAttribute.family)
    if family not in (socket.AF_INET, socket.AF_INET6):
        return "a local process"
    address = stream.extra(SocketAttribute.remote_address, None)
    # A peer that has reset the connection before this has no address any more.
    return f"{address[0]}:{address[1]}" if isinstance(address, tuple) else "a peer that has left"


async def leave(stream: ByteStream, last: bytes = b"") -> None:
    """Send the last bytes, end the stream, and give the peer a moment to read what was sent.

    If what it has sent meanwhile were not read, closing would reset the connection, and the answer
    could be lost on the way.
    """
    with anyio.move_on_after(LEAVE), suppress(*BROKEN):
        if last:
            await stream.send(last)
        with suppress(NotImplementedError):  # TLS
            await stream.send_eof()
        while True:
            await stream.receive(CHUNK)

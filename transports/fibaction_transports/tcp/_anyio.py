"""Connections as anyio has them: on every backend, and with TLS."""

from __future__ import annotations

import socket
from collections.abc import Callable, Coroutine
from typing import Any

from anyio.abc import AnyByteStream, ByteStream, Listener, SocketAttribute, TaskGroup

from fibaction.wire.channel import Line, StreamChannel


async def accept(
    listener: Listener[Any],
    max_frame: int,
    serve: Callable[[Line], Coroutine[Any, Any, None]],
    tasks: TaskGroup,
) -> None:
    """Serve whoever connects, each in a task of its own, until that cannot be done.

    Raises:
        OSError: A connection could not be accepted.
    """

    async def begin(stream: ByteStream) -> None:
        await serve(StreamChannel(stream, peer_of(stream), max_frame))

    await listener.serve(begin, tasks)


def peer_of(stream: AnyByteStream) -> str:
    """Who is at the other end, for a person to read."""
    family = stream.extra(SocketAttribute.family)
    if family == socket.AF_UNIX:
        return "a local process"
    address = stream.extra(SocketAttribute.remote_address, None)
    # It is not known of a peer that has reset the connection before it was looked at.
    return f"{address[0]}:{address[1]}" if isinstance(address, tuple) else "a peer that has left"

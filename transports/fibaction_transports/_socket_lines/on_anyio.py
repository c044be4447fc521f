"""Connections over the streams of anyio: on every backend, and with TLS."""

from __future__ import annotations

import socket
from collections.abc import Callable, Coroutine
from typing import Any

from anyio.abc import AnyByteStream, ByteStream, Listener, SocketAttribute, TaskGroup

from fibaction.wire.channel import Line, StreamChannel
from fibaction.wire.frames import Framing


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

    await listener.serve(begin, tasks)


def peer_of(stream: AnyByteStream) -> str:
    """Return the address of the peer, for logs."""
    family = stream.extra(SocketAttribute.family)
    if family not in (socket.AF_INET, socket.AF_INET6):
        return "a local process"
    address = stream.extra(SocketAttribute.remote_address, None)
    # A peer that has reset the connection before this has no address any more.
    return f"{address[0]}:{address[1]}" if isinstance(address, tuple) else "a peer that has left"

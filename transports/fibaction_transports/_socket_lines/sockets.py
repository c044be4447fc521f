"""Clients that are accepted: their streams on every backend, and on asyncio their sockets.

A stream over such a socket can be given up for a line.
"""

from __future__ import annotations

import socket
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from contextlib import suppress
from functools import partial
from typing import Any, TypeVar

import anyio
import anyio.lowlevel
from anyio.abc import AnyByteStream, ByteStream, Listener, SocketAttribute, TaskGroup

from fibaction.border.event_loop import asyncio_loop
from fibaction.border.peer_text import clean_logger
from fibaction.wire.channel import CHUNK, LEAVE, Line, StreamChannel
from fibaction.wire.frames import Framing

T = TypeVar("T")

logger = clean_logger("fibaction.wire")

BROKEN = (OSError, anyio.BrokenResourceError, anyio.ClosedResourceError, anyio.EndOfStream)
"""The errors of a stream whose peer has gone."""
BATCH = 16
"""Connections that are accepted in one turn of the event loop: each costs the next turns more."""


class SocketStream(ByteStream):
    """A stream over a socket that does not block.

    It reads nothing ahead and has no task, so the socket can be taken from it at any time between
    two calls.
    """

    def __init__(self, accepted: socket.socket) -> None:
        self._socket = accepted
        self._is_owner = True

    def detach(self) -> socket.socket:
        """Give up the socket, which the caller owns from now on."""
        self._is_owner = False
        return self._socket

    @property
    def extra_attributes(self) -> Mapping[Any, Callable[[], Any]]:
        """The attributes that anyio's streams have, as far as logs need them."""
        return {
            SocketAttribute.family: lambda: self._socket.family,
            SocketAttribute.remote_address: self._peer,
        }

    def _peer(self) -> Any:
        """Return the address of the peer; None if the peer has reset the connection."""
        try:
            return self._socket.getpeername()
        except OSError:
            return None

    async def receive(self, max_bytes: int = 2**16) -> bytes:
        await anyio.lowlevel.checkpoint()
        while True:
            try:
                data = self._socket.recv(max_bytes)
            except BlockingIOError:
                await anyio.wait_readable(self._socket)
            else:
                if not data:
                    raise anyio.EndOfStream
                return data

    def send_now(self, item: bytes) -> bytes:
        """Send as much as the socket takes without waiting, and return the rest.

        Raises:
            OSError: The connection is broken.
        """
        try:
            return item[self._socket.send(item) :]
        except BlockingIOError:
            return item

    async def send(self, item: bytes) -> None:
        await anyio.lowlevel.checkpoint()
        while item := self.send_now(item):
            await anyio.wait_writable(self._socket)

    async def send_eof(self) -> None:
        self._socket.shutdown(socket.SHUT_WR)

    async def aclose(self) -> None:
        if self._is_owner and self._socket.fileno() >= 0:
            anyio.notify_closing(self._socket)
            self._socket.close()
        await anyio.lowlevel.checkpoint()


async def accept_sockets(
    listener: Listener[Any],
    begin: Callable[[socket.socket], Coroutine[Any, Any, None]],
    tasks: TaskGroup,
) -> None:
    """Begin a task with the socket of each client that connects, until accepting fails.

    Clients that come at the same time are accepted together, `BATCH` in a turn of the event loop.

    Raises:
        OSError: A connection could not be accepted.
    """
    loop = asyncio_loop()
    listening = listener.extra(SocketAttribute.raw_socket)
    while True:
        accepted, _ = await loop.sock_accept(listening)
        tasks.start_soon(serve_alone, begin, _without_delay(accepted))
        for _ in range(BATCH - 1):
            try:
                accepted, _ = listening.accept()
            except BlockingIOError:
                break
            accepted.setblocking(False)
            tasks.start_soon(serve_alone, begin, _without_delay(accepted))
        await anyio.lowlevel.checkpoint()  # it need not have waited


async def serve_alone(serve: Callable[[T], Awaitable[None]], client: T) -> None:
    """Serve one client in a task of its own; what goes wrong with it ends no other one."""
    try:
        await serve(client)
    except Exception as exc:
        logger.error("a connection failed", exc_info=exc)


def _without_delay(accepted: socket.socket) -> socket.socket:
    if accepted.family in (socket.AF_INET, socket.AF_INET6):
        # asyncio sets it only where the socket names its protocol, which this one does not. A peer
        # that has gone meanwhile is noticed later.
        with suppress(OSError):
            accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return accepted


async def accept_streams(
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

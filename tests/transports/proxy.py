"""A line between a client and a server that goes bad when a test wants it to."""

from __future__ import annotations

import socket
import struct
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager, suppress

import anyio
from anyio.abc import SocketAttribute, SocketStream

from fibaction._runtime.notify import Notifier
from fibaction.border.event_loop import Background

BROKEN: tuple[type[Exception], ...] = (
    OSError,
    anyio.BrokenResourceError,
    anyio.ClosedResourceError,
)


class Line:
    """All connections through one proxy, in both directions."""

    def __init__(self, url: str) -> None:
        self.url = url
        """Where clients are to connect to."""
        self.opened = 0
        """How many connections there have been, those that were refused included."""
        self.refuses = False
        """Whether new connections are closed at once."""
        self.delay = 0.0
        """Seconds that everything takes longer."""
        self._quiet: set[str] = set()
        self._swallowed = anyio.Event()
        self._changed = Notifier()
        self._streams: dict[SocketStream, SocketStream] = {}

    def cut(self) -> None:
        """Reset all connections."""
        for stream in (*self._streams, *self._streams.values()):
            _reset(stream)
        self._streams.clear()

    def hush(self, *directions: str) -> None:
        """Hand on no more `to server` or `to client`, and tell nobody; neither: all goes on."""
        self._quiet = set(directions)
        self._swallowed = anyio.Event()
        self._changed.notify()

    async def swallows(self) -> None:
        """Wait until something has come that is not handed on."""
        with anyio.fail_after(30):
            await self._swallowed.wait()

    async def serve(self, client: SocketStream, port: int) -> None:
        self.opened += 1
        self._changed.notify()
        async with client:
            try:
                if self.refuses:
                    raise ConnectionRefusedError
                server = await anyio.connect_tcp("127.0.0.1", port)
            except OSError:
                _reset(client)
                return
            self._streams[client] = server
            async with server, anyio.create_task_group() as tasks:
                tasks.start_soon(self._pump, client, server, "to server")
                tasks.start_soon(self._pump, server, client, "to client")
            self._streams.pop(client, None)

    async def _pump(self, source: SocketStream, target: SocketStream, direction: str) -> None:
        try:
            while True:
                data = await source.receive()
                await anyio.sleep(self.delay)
                while direction in self._quiet:
                    self._swallowed.set()
                    await self._changed.wait()
                await target.send(data)
        except anyio.EndOfStream:
            with suppress(*BROKEN):
                await target.send_eof()
        except BROKEN:
            _reset(source)
            _reset(target)


@asynccontextmanager
async def line_to(url: str) -> AsyncGenerator[Line, None]:
    """A line to a server at a port of this machine."""
    scheme, port = url.partition("://")[0], int(url.rpartition(":")[2])
    async with await anyio.create_tcp_listener(local_host="127.0.0.1") as listener:
        line = Line(f"{scheme}://127.0.0.1:{listener.extra(SocketAttribute.local_port)}")

        async def serve(client: SocketStream) -> None:
            await line.serve(client, port)

        async with Background() as tasks:
            tasks.start_soon(listener.serve, serve)
            yield line


def _reset(stream: SocketStream) -> None:
    """Make the socket one that both sides find broken as soon as they use it."""
    raw = stream.extra(SocketAttribute.raw_socket)
    try:
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        raw.shutdown(socket.SHUT_RDWR)
    except OSError:
        pass  # it has ended before

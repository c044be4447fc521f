"""The costs of the two kinds of lines over TCP, with and without TLS, beside each other.

    python -m tests.tools.benchmarks.lines

A program sends frames to itself over a loopback connection: first each is answered before the next
is sent, then many at once. All kinds take turns in one process, so that a busy machine slows both.
It prints the median time of a frame there and back, and the ratio of each kind to that of asyncio;
before that, what a connection with TLS costs, with a new session and with one that is resumed.
"""

from __future__ import annotations

import socket
import statistics
from collections.abc import AsyncGenerator, Callable, Coroutine
from contextlib import asynccontextmanager, suppress
from time import perf_counter, process_time
from typing import Any

import anyio
from anyio.abc import Listener, SocketAttribute
from anyio.streams.tls import TLSStream

from fibaction._runtime.notify import Notifier
from fibaction.wire.channel import Line, StreamChannel
from fibaction.wire.frames import FrameReader
from fibaction.wire.tls_files import TlsFiles
from fibaction.words.errors import ConnectionLost
from fibaction_transports._socket_lines import on_anyio, on_asyncio
from fibaction_transports._socket_lines.client_tls import ClientTls
from fibaction_transports._socket_lines.tls import TlsChannel, TlsListener
from fibaction_transports._socket_lines.tls_lines import accept_tls, dial_tls
from tests.support.certificates import HOST, pems

FRAME = bytes(100)
TURNS = 7
CONNECTIONS = 100
TRIPS = ((1, 2000), (64, 20_000))
"""The frames that are under way at once, and how many are sent in all."""
KINDS = ("asyncio", "anyio", "asyncio, TLS", "anyio, TLS")


class End:
    """One end of a line: the frames to send, and the number of those that arrived."""

    def __init__(self, line: Line, *, echoes: bool) -> None:
        self._line = line
        self._echoes = echoes
        self._queue: list[bytes] = []
        self._arrived = 0
        self._news = Notifier()

    async def run(self) -> None:
        await self._line.run(self._on_frames, self._next_frames)

    def _on_frames(self, frames: list[bytes]) -> list[bytes]:
        if self._echoes:
            self.send(frames)
        else:
            self._arrived += len(frames)
            self._news.notify()
        return []

    def _next_frames(self) -> list[bytes]:
        frames, self._queue = self._queue, []
        return frames

    def send(self, frames: list[bytes]) -> None:
        self._queue += frames
        self._line.wake_writer()

    async def round_trips(self, count: int, at_once: int) -> float:
        """Return the seconds for one frame there and back."""
        begun = perf_counter()
        for _ in range(count // at_once):
            wanted = self._arrived + at_once
            self.send([FRAME] * at_once)
            while self._arrived < wanted:
                await self._news.wait()
        return (perf_counter() - begun) / count


@asynccontextmanager
async def ends(kind: str) -> AsyncGenerator[End, None]:
    """Open a connection whose other end echoes."""
    accept: Callable[..., Coroutine[Any, Any, None]] = on_anyio.accept
    if kind.startswith("asyncio"):
        accept = accept_tls if kind.endswith("TLS") else on_asyncio.accept
    async with (
        await anyio.create_tcp_listener(local_host="127.0.0.1") as listener,
        anyio.create_task_group() as tasks,
    ):

        async def serve(line: Line) -> None:
            await End(line, echoes=True).run()

        # For one host, it is a list of one listener.
        one: Listener[Any]
        (one,) = listener.listeners
        if kind.endswith("TLS"):
            one = TlsListener(one, TlsFiles(cert=pems().cert).server())
        tasks.start_soon(accept, one, FrameReader, serve, tasks)
        end = End(await dial(kind, listener.extra(SocketAttribute.local_port)), echoes=False)
        tasks.start_soon(end.run)
        yield end
        tasks.cancel_scope.cancel()


async def dial(kind: str, port: int) -> Line:
    """Connect to a port of this machine."""
    context = TlsFiles(ca=pems().ca).client()
    if kind == "asyncio":
        return await on_asyncio.dial_tcp(HOST, port, FrameReader(), "here")
    if kind == "asyncio, TLS":
        return await dial_tls(HOST, port, FrameReader(), "here", ClientTls(context))
    stream = await anyio.connect_tcp(HOST, port)
    stream.extra(SocketAttribute.raw_socket).setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    if kind == "anyio":
        return StreamChannel(stream, "here", FrameReader())
    tls = await TLSStream.wrap(stream, hostname=HOST, ssl_context=context)
    return TlsChannel(tls, "here", FrameReader())


@asynccontextmanager
async def tls_port() -> AsyncGenerator[int, None]:
    """Serve TLS, and give the port."""
    async with (
        await anyio.create_tcp_listener(local_host=HOST) as listener,
        anyio.create_task_group() as tasks,
    ):

        async def serve(line: Line) -> None:
            with suppress(ConnectionLost):
                await End(line, echoes=True).run()
            await line.aclose()

        one = TlsListener(listener.listeners[0], TlsFiles(cert=pems().cert).server())
        tasks.start_soon(accept_tls, one, FrameReader, serve, tasks)
        yield listener.extra(SocketAttribute.local_port)
        tasks.cancel_scope.cancel()


async def connections(port: int, count: int, *, resume: bool) -> float:
    """Return the processor's seconds of both ends for a connection that is opened and closed."""
    given = TlsFiles(ca=pems().ca)
    tls = ClientTls(given)
    begun = process_time()
    for _ in range(count):
        line = await dial_tls(HOST, port, FrameReader(), "here", tls)
        end = End(line, echoes=False)
        # The server tells the session with its first bytes.
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(end.run)
            await end.round_trips(1, 1)
            tasks.cancel_scope.cancel()
        await line.aclose()
        if not resume:
            tls = ClientTls(given)
    return (process_time() - begun) / count


async def measure() -> None:
    async with tls_port() as port:
        ways: dict[bool, list[float]] = {False: [], True: []}
        for _ in range(TURNS):
            for resume, taken in ways.items():
                taken.append(await connections(port, CONNECTIONS, resume=resume))
        anew, resumed = (statistics.median(taken) * 1e3 for taken in ways.values())
        print(f"a connection with TLS: {anew:.2f} ms, resumed {resumed:.2f} ms of the processor")
    for at_once, count in TRIPS:
        times: dict[str, list[float]] = {kind: [] for kind in KINDS}
        for _ in range(TURNS):
            for kind, taken in times.items():
                async with ends(kind) as end:
                    await end.round_trips(count // 10, at_once)
                    taken.append(await end.round_trips(count, at_once))
        medians = {kind: statistics.median(taken) * 1e6 for kind, taken in times.items()}
        for kind, median in medians.items():
            ratio = median / medians["asyncio"]
            print(f"{at_once:3} at once: {kind:12} {median:6.1f} us a frame, ratio {ratio:.2f}")


def main() -> None:
    anyio.run(measure)


if __name__ == "__main__":
    main()

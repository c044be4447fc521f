"""The costs of the two kinds of lines over TCP, beside each other.

    python -m tests.benchmarks.lines

A program sends frames to itself over a loopback connection: first each is answered before the next
is sent, then many at once. Both kinds take turns in one process, so that a busy machine slows both.
It prints the median time of a frame there and back, and the ratio of the two.
"""

from __future__ import annotations

import socket
import statistics
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from time import perf_counter

import anyio
from anyio.abc import SocketAttribute, SocketStream

from fibaction._notify import Notifier
from fibaction.wire.channel import Line, StreamChannel
from fibaction.wire.frames import FrameReader
from fibaction_transports._streams import _anyio, _asyncio

FRAME = bytes(100)
TURNS = 7


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
    accept = {"asyncio": _asyncio.accept, "anyio": _anyio.accept}[kind]
    async with (
        await anyio.create_tcp_listener(local_host="127.0.0.1") as listener,
        anyio.create_task_group() as tasks,
    ):

        async def serve(line: Line) -> None:
            await End(line, echoes=True).run()

        # For one host, it is a list of one listener.
        (one,) = listener.listeners
        tasks.start_soon(accept, one, FrameReader, serve, tasks)
        port = listener.extra(SocketAttribute.local_port)
        line: Line
        if kind == "asyncio":
            line = await _asyncio.dial_tcp("127.0.0.1", port, FrameReader(), "here")
        else:
            stream: SocketStream = await anyio.connect_tcp("127.0.0.1", port)
            stream.extra(SocketAttribute.raw_socket).setsockopt(
                socket.IPPROTO_TCP, socket.TCP_NODELAY, 1
            )
            line = StreamChannel(stream, "here", FrameReader())
        end = End(line, echoes=False)
        tasks.start_soon(end.run)
        yield end
        tasks.cancel_scope.cancel()


async def main() -> None:
    for at_once, count in ((1, 2000), (64, 20_000)):
        times: dict[str, list[float]] = {"asyncio": [], "anyio": []}
        for _ in range(TURNS):
            for kind, taken in times.items():
                async with ends(kind) as end:
                    await end.round_trips(count // 10, at_once)
                    taken.append(await end.round_trips(count, at_once))
        medians = {kind: statistics.median(taken) * 1e6 for kind, taken in times.items()}
        print(
            f"{at_once:3} at once: _asyncio {medians['asyncio']:.1f} us, _anyio"
            f" {medians['anyio']:.1f} us a frame, ratio {medians['anyio'] / medians['asyncio']:.2f}"
        )


if __name__ == "__main__":
    anyio.run(main)

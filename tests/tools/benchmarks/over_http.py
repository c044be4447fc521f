"""REST and server-sent events of `http://`, by a client that knows nothing of fibaction.

The server is measured, and not a parser of HTTP: the client writes the bytes of its requests and
cuts the answers at their lengths and events, so it takes a sixth of the time that one over h11
does. Goals at once share `CONNECTIONS` connections, since each has one request at a time.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from time import perf_counter

import msgspec
from anyio import connect_tcp, create_task_group
from anyio.abc import SocketStream

from tests.tools.benchmarks import over_fibaction
from tests.tools.benchmarks.contender import AT_ONCE, Contender, GoalTimes
from tests.tools.benchmarks.inprocess import Feedback
from tests.transports.hearing import port_of

GOALS = "/actions/count/goals"
CONNECTIONS = 20
EVENTS = "text/event-stream"

decoded = msgspec.json.Decoder(Feedback).decode


def request_of(count: int, path: str, *headers: str) -> bytes:
    """Return the bytes of a request that sends a goal."""
    body = msgspec.json.encode({"count": count})
    lines = [f"POST {path} HTTP/1.1", "host: 127.0.0.1", "content-type: application/json"]
    lines += [f"content-length: {len(body)}", *headers]
    return "".join(f"{line}\r\n" for line in (*lines, "")).encode() + body


AT_END = request_of(0, f"{GOALS}?wait=30")
"""The request of a goal without feedback, which is answered at its end."""


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    async with over_fibaction.serve("http://127.0.0.1:0") as url:
        yield url


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    yield OverHttp(address)


async def run_goal(stream: SocketStream) -> None:
    """Send a goal, and receive the answer, whose body has the length that a header says."""
    await stream.send(AT_END)
    answer = await stream.receive()
    while (end := answer.find(b"\r\n\r\n")) < 0:
        answer += await stream.receive()
    assert answer.startswith(b"HTTP/1.1 201 "), answer
    length = answer[:end].lower().partition(b"\r\ncontent-length: ")[2]
    size = end + 4 + int(length.partition(b"\r\n")[0])
    while len(answer) < size:
        answer += await stream.receive()


class OverHttp(Contender):
    """Each piece of work opens its connections: between two, the server ends idle ones."""

    def __init__(self, address: str) -> None:
        self._port = port_of(address)

    async def goal(self) -> None:
        await self.goals(1)

    async def goals(self, times: int) -> None:
        async with await connect_tcp("127.0.0.1", self._port) as stream:
            for _ in range(times):
                await run_goal(stream)

    async def batches(self, times: int) -> int:
        each = times * AT_ONCE // CONNECTIONS
        async with create_task_group() as tasks:
            for _ in range(CONNECTIONS):
                tasks.start_soon(self.goals, each)
        return each * CONNECTIONS

    async def goal_times(self, times: int) -> list[GoalTimes]:
        taken: list[GoalTimes] = []
        async with await connect_tcp("127.0.0.1", self._port) as stream:
            for _ in range(times):
                start = perf_counter()
                await run_goal(stream)
                taken.append(GoalTimes(None, perf_counter() - start))
        return taken

    async def numbers_of(self, goal: int) -> AsyncGenerator[list[int], None]:
        """Send a goal with a stream of its events."""
        async with await connect_tcp("127.0.0.1", self._port) as stream:
            await stream.send(request_of(goal, GOALS, f"accept: {EVENTS}"))
            left = await stream.receive()
            assert left.startswith(b"HTTP/1.1 201 "), left
            while True:
                *events, left = left.split(b"\n\n")  # a chunk has whole events
                for event in events:
                    if event.find(b"event: feedback") >= 0:
                        yield decoded(event.partition(b"\ndata: ")[2]).numbers
                    elif event.find(b"event: result") >= 0:
                        return
                left += await stream.receive()

"""gRPC: a goal is a call of a method that streams the feedback, and the result last.

The payloads are the same as fibaction's, so that only what carries them differs.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

from tests.tools.benchmarks.contender import AT_ONCE, PACED, PENDING, Contender, messages_of
from tests.tools.benchmarks.inprocess import ACTION, Feedback, Goal, Result

SERVICE, METHOD = "Count", "send_goal"
GRACE = 1.0
"""Seconds that active calls have when the server stops."""


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    import grpc.aio  # imported here, since the other benchmarks run without it

    async def send_goal(request: bytes, _context: Any) -> AsyncGenerator[bytes, None]:
        wanted = ACTION.goal.decode(request).count
        async for message in messages_of(wanted, Feedback):
            yield ACTION.feedback.encode(message)
        yield ACTION.result.encode(Result(wanted))

    server = grpc.aio.server()
    # Without serializers, bytes go through as they are.
    methods = {METHOD: grpc.unary_stream_rpc_method_handler(send_goal)}
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, methods),))
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    try:
        yield f"127.0.0.1:{port}"
    finally:
        await server.stop(GRACE)


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    import grpc.aio

    async with grpc.aio.insecure_channel(address) as channel:
        yield OverGrpc(channel)


class OverGrpc(Contender):
    def __init__(self, channel: Any) -> None:
        self._send_goal = channel.unary_stream(f"/{SERVICE}/{METHOD}")
        self._pending: list[Any] = []

    async def goal(self) -> None:
        async for _ in self.numbers_of(0):
            pass

    async def numbers_of(self, goal: int) -> AsyncGenerator[list[int], None]:
        seen, last = 0, b""
        async for message in self._send_goal(ACTION.goal.encode(Goal(goal))):
            if last:
                seen += 1
                yield ACTION.feedback.decode(last).numbers
            last = message
        count = goal - PACED if goal >= PACED else goal
        assert (ACTION.result.decode(last), seen) == (Result(goal), count), "feedback was lost"

    async def hold(self, times: int) -> None:
        # While more than 1,000 wait for a handler, gRPC's core rejects some, and from 3,000 on
        # all: `grpc.server.max_pending_requests`, https://github.com/grpc/grpc/pull/34782
        for begun in range(0, times, AT_ONCE):
            self._pending += [
                self._send_goal(ACTION.goal.encode(Goal(PENDING)))
                for _ in range(min(AT_ONCE, times - begun))
            ]
            # A call that was sent after them is answered, so the server has them all.
            await self.goal()

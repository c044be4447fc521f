"""gRPC: a goal is a call of a method that streams the feedback, and the result last.

The payloads are the same as fibaction's, so that only what carries them differs.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
from anyio import create_task_group

from tests.tools.benchmarks.contender import (
    AT_ONCE,
    PACED,
    PAUSE,
    PENDING,
    Contender,
    seconds_since,
    stamped,
)
from tests.tools.benchmarks.inprocess import ACTION, Feedback, Goal, Result

SERVICE, METHOD = "Count", "send_goal"
GRACE = 1.0
"""Seconds that active calls have when the server stops."""


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    import grpc.aio  # imported here, since the other benchmarks run without it

    async def send_goal(request: bytes, _context: Any) -> AsyncGenerator[bytes, None]:
        wanted = ACTION.goal.decode(request).count
        if wanted >= PACED:
            for _ in range(wanted - PACED):
                await anyio.sleep(PAUSE)
                yield ACTION.feedback.encode(Feedback(stamped()))
        else:
            feedback = Feedback([1, 2, 3])
            for _ in range(wanted):
                yield ACTION.feedback.encode(feedback)
        if wanted == PENDING:
            await anyio.sleep_forever()
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

    async def goals(self, times: int) -> None:
        for _ in range(times):
            await self._call(0)

    async def batches(self, times: int) -> int:
        for _ in range(times):
            async with create_task_group() as tasks:
                for _ in range(AT_ONCE):
                    tasks.start_soon(self._call, 0)
        return times * AT_ONCE

    async def feedback(self, times: int) -> int:
        await self._call(times)
        return times

    async def feedback_times(self, times: int) -> list[float]:
        taken: list[float] = []
        async for message in self._send_goal(ACTION.goal.encode(Goal(PACED + times))):
            if len(taken) < times:  # the last one is the result
                taken.append(seconds_since(ACTION.feedback.decode(message).numbers))
        return taken

    async def hold(self, times: int) -> None:
        # While more than 1,000 wait for a handler, gRPC's core rejects some, and from 3,000 on
        # all: `grpc.server.max_pending_requests`, https://github.com/grpc/grpc/pull/34782
        for begun in range(0, times, AT_ONCE):
            self._pending += [
                self._send_goal(ACTION.goal.encode(Goal(PENDING)))
                for _ in range(min(AT_ONCE, times - begun))
            ]
            # A call that was sent after them is answered, so the server has them all.
            await self._call(0)

    async def _call(self, count: int) -> None:
        seen, last = 0, b""
        async for message in self._send_goal(ACTION.goal.encode(Goal(count))):
            if last:
                ACTION.feedback.decode(last)
                seen += 1
            last = message
        assert ACTION.result.decode(last) == Result(seen) == Result(count), "feedback was lost"

"""The limit with the same bookkeeping: bare frames, and a task and an event for each goal.

Each goal has an ID and a task at both ends, and its two messages are made and read one by one. What
is written in one turn of the event loop is written together. There are no decisions, no limits, no
statuses, and nothing is kept. Feedback is that of `over_sockets`.
"""

from __future__ import annotations

import itertools
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import anyio
from anyio.abc import SocketStream

from fibaction import GoalStatus
from fibaction.wire import messages
from fibaction.wire.codec import decode_from_client, decode_from_server
from fibaction.wire.frames import MAX_FRAME, FrameReader
from tests.tools.benchmarks import over_sockets
from tests.tools.benchmarks.contender import Contender
from tests.tools.benchmarks.inprocess import ACTION, Goal, Result
from tests.tools.benchmarks.over_sockets import (
    CALL,
    CHUNK,
    STAMP,
    OverSockets,
    framed,
    without_delay,
)

GOAL_ID = bytes(range(16))


class Writer:
    """Writes what is added in one turn of the event loop together."""

    def __init__(self, stream: SocketStream) -> None:
        self._stream = stream
        self._data = bytearray()
        self._added = anyio.Event()

    def add(self, frame: bytes) -> None:
        self._data += frame
        self._added.set()

    async def run(self) -> None:
        while True:
            await self._added.wait()
            data, self._data, self._added = self._data, bytearray(), anyio.Event()
            await self._stream.send(bytes(data))


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    async with over_sockets.serve(answer_goals) as address:
        yield address


async def answer_goals(stream: SocketStream) -> None:
    without_delay(stream)
    reader, writer = FrameReader(MAX_FRAME), Writer(stream)
    async with stream, anyio.create_task_group() as tasks:
        tasks.start_soon(writer.run)
        async for data in stream:
            for frame in reader.feed(data):
                tasks.start_soon(answer, frame, writer)
        tasks.cancel_scope.cancel()


async def answer(frame: bytes, writer: Writer) -> None:
    request = decode_from_client(frame)
    assert isinstance(request, messages.SendGoal)
    goal = ACTION.goal.decode(request.goal)
    status = GoalStatus.EXECUTING
    writer.add(framed(messages.Following(request.id, STAMP, status, latest=False, place=0)))
    result = ACTION.result.encode(Result(goal.count))
    writer.add(framed(messages.Ended(request.id, GoalStatus.SUCCEEDED, result, "", 0)))


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    async with over_sockets.connected(address) as (goals, feedback):
        contender = OverTaskSockets(goals, feedback)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(contender.writer.run)
            tasks.start_soon(contender.read)
            yield contender
            tasks.cancel_scope.cancel()


class OverTaskSockets(OverSockets):
    def __init__(self, goals: SocketStream, feedback: SocketStream) -> None:
        super().__init__(goals, feedback)
        self.writer = Writer(goals)
        self._ids = itertools.count(CALL)
        self._ended: dict[int, anyio.Event] = {}

    goals, batches = Contender.goals, Contender.batches

    async def goal(self) -> None:
        call_id = next(self._ids)
        goal = ACTION.goal.encode(Goal(0))
        self.writer.add(framed(messages.SendGoal(call_id, ACTION.name, GOAL_ID, goal, credit=0)))
        self._ended[call_id] = ended = anyio.Event()
        await ended.wait()

    async def read(self) -> None:
        """Read the messages of the server, and wake the goals that have ended."""
        reader = FrameReader(MAX_FRAME)
        while True:
            for frame in reader.feed(await self._goals.receive(CHUNK)):
                message = decode_from_server(frame)
                if isinstance(message, messages.Ended):
                    assert message.result is not None
                    ACTION.result.decode(message.result)
                    self._ended.pop(message.id).set()

"""The limit: fibaction's bytes over anyio's sockets, without decisions, dispatch or waits.

There is a port for goals, where each frame is answered with two, and one for feedback, where a
number is answered with as many frames.

`tasks` is the limit with the same bookkeeping. Each goal has an ID, and a task and an event at both
ends, and its two messages are made and read one by one. What is written in one turn of the event
loop is written together. There are no limits and no statuses, and nothing is kept.
"""

from __future__ import annotations

import itertools
import socket
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from functools import partial

import anyio
from anyio.abc import SocketAttribute, SocketStream

from fibaction import GoalStatus
from fibaction.wire import messages
from fibaction.wire.frames import MAX_FRAME, FrameReader, header
from fibaction.wire.messages import decode_from_client, decode_from_server, encode
from fibaction.words.goals import GoalID
from tests.tools.benchmarks.contender import AT_ONCE, PACED, Contender, Ends, messages_of
from tests.tools.benchmarks.inprocess import ACTION, Feedback, Goal, Result

CHUNK = 2**16
"""Bytes read or written at once, as over fibaction."""
NUMBER = 4
"""Bytes of the number of feedback messages that are wanted."""
CALL = 100_000
"""The ID of a call, and a goal's stamp, as many bytes long as they are after many goals."""
STAMP = 1_800_000_000_000_000_000
GOAL_ID = GoalID(bytes(range(16)))


def framed(message: object) -> bytes:
    frame = encode(message)
    return header(len(frame)) + frame


def request(call: int) -> bytes:
    goal = ACTION.goal.encode(Goal(0))
    return framed(messages.SendGoal(call, ACTION.name, GOAL_ID, goal, credit=0))


def following(call: int) -> bytes:
    return framed(messages.Following(call, STAMP, GoalStatus.EXECUTING, latest=False, place=0))


def ended(call: int, result: Result) -> bytes:
    payload = ACTION.result.encode(result)
    return framed(messages.Ended(call, GoalStatus.SUCCEEDED, payload, "", 0))


REQUEST, ANSWER = request(CALL), following(CALL) + ended(CALL, Result(0))


async def answer_goals(stream: SocketStream) -> None:
    without_delay(stream)
    reader = FrameReader(MAX_FRAME)
    async with stream:
        async for data in stream:
            await stream.send(ANSWER * len(reader.feed(data)))


@asynccontextmanager
async def serve(
    answer: Callable[[SocketStream], Awaitable[None]] = answer_goals,
) -> AsyncGenerator[str, None]:
    """Serve; `answer` takes the connections for goals."""
    async with (
        await anyio.create_tcp_listener(local_host="127.0.0.1") as for_goals,
        await anyio.create_tcp_listener(local_host="127.0.0.1") as for_feedback,
        anyio.create_task_group() as tasks,
    ):
        tasks.start_soon(for_goals.serve, answer)
        tasks.start_soon(for_feedback.serve, send_feedback)
        yield " ".join(
            str(listener.extra(SocketAttribute.local_port))
            for listener in (for_goals, for_feedback)
        )
        tasks.cancel_scope.cancel()


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


async def answer_goals_in_tasks(stream: SocketStream) -> None:
    without_delay(stream)
    reader, writer = FrameReader(MAX_FRAME), Writer(stream)
    async with stream, anyio.create_task_group() as tasks:
        tasks.start_soon(writer.run)
        async for data in stream:
            for frame in reader.feed(data):
                tasks.start_soon(answer_goal, frame, writer)
        tasks.cancel_scope.cancel()


async def answer_goal(frame: bytes, writer: Writer) -> None:
    sent = decode_from_client(frame)
    assert isinstance(sent, messages.SendGoal)
    goal = ACTION.goal.decode(sent.goal)
    writer.add(following(sent.id))
    writer.add(ended(sent.id, Result(goal.count)))


async def send_feedback(stream: SocketStream) -> None:
    without_delay(stream)
    async with stream:
        async for wanted in stream:
            times = int.from_bytes(wanted, "big")
            if times >= PACED:
                number = 0
                async for feedback in messages_of(times, Feedback):
                    number += 1
                    await stream.send(feedback_frame(number, feedback))
            else:
                await send_as_quickly_as_can_be(stream, times)


async def send_as_quickly_as_can_be(stream: SocketStream, times: int) -> None:
    feedback = Feedback([1, 2, 3])
    chunk = bytearray()
    for number in range(1, times + 1):
        frame = feedback_frame(number, feedback)
        if len(chunk) + len(frame) > CHUNK:
            await stream.send(bytes(chunk))
            chunk = bytearray()
        chunk += frame
    await stream.send(bytes(chunk))


def feedback_frame(number: int, feedback: Feedback) -> bytes:
    return framed(messages.Feedback(CALL, number, ACTION.feedback.encode(feedback)))


@asynccontextmanager
async def connected(address: str) -> AsyncGenerator[tuple[SocketStream, SocketStream], None]:
    """Connect for goals, and for feedback."""
    goals, feedback = map(int, address.split())
    async with (
        await anyio.connect_tcp("127.0.0.1", goals) as for_goals,
        await anyio.connect_tcp("127.0.0.1", feedback) as for_feedback,
    ):
        yield for_goals, for_feedback


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    async with connected(address) as streams:
        yield OverSockets(*streams)


@asynccontextmanager
async def connect_with_tasks(address: str) -> AsyncGenerator[Contender, None]:
    async with connected(address) as streams, anyio.create_task_group() as tasks:
        contender = OverTaskSockets(*streams)
        tasks.start_soon(contender.writer.run)
        tasks.start_soon(contender.read)
        yield contender
        tasks.cancel_scope.cancel()


ENDS = {"tasks": Ends(partial(serve, answer_goals_in_tasks), connect_with_tasks)}


class OverSockets(Contender):
    def __init__(self, goals: SocketStream, feedback: SocketStream) -> None:
        self._goals = goals
        self._feedback = feedback
        for stream in (goals, feedback):
            without_delay(stream)

    async def goal(self) -> None:
        await self._exchange(1, 1)

    async def goals(self, times: int) -> None:
        await self._exchange(times, 1)

    async def batches(self, times: int) -> int:
        await self._exchange(times, AT_ONCE)
        return times * AT_ONCE

    async def numbers_of(self, goal: int) -> AsyncGenerator[list[int], None]:
        reader = FrameReader(MAX_FRAME)
        await self._feedback.send(goal.to_bytes(NUMBER, "big"))
        left = goal - PACED if goal >= PACED else goal
        while left:
            for frame in reader.feed(await self._feedback.receive(CHUNK)):
                left -= 1
                message = decode_from_server(frame)
                assert isinstance(message, messages.Feedback)
                yield ACTION.feedback.decode(message.payload).numbers

    async def _exchange(self, times: int, size: int) -> None:
        reader = FrameReader(MAX_FRAME)
        requests = REQUEST * size
        for _ in range(times):
            await self._goals.send(requests)
            seen = 0
            while seen < 2 * size:
                seen += len(reader.feed(await self._goals.receive(CHUNK)))


class OverTaskSockets(OverSockets):
    def __init__(self, goals: SocketStream, feedback: SocketStream) -> None:
        super().__init__(goals, feedback)
        self.writer = Writer(goals)
        self._ids = itertools.count(CALL)
        self._ended: dict[int, anyio.Event] = {}

    goals, batches = Contender.goals, Contender.batches

    async def goal(self) -> None:
        call_id = next(self._ids)
        self.writer.add(request(call_id))
        self._ended[call_id] = has_ended = anyio.Event()
        await has_ended.wait()

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


def without_delay(stream: SocketStream) -> None:
    raw = stream.extra(SocketAttribute.raw_socket)
    raw.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

"""The limit: fibaction's bytes over anyio's sockets, without decisions, dispatch or waits.

There is a port for goals, where each frame is answered with two, and one for feedback, where a
number is answered with as many frames.
"""

from __future__ import annotations

import socket
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager

import anyio
from anyio.abc import SocketAttribute, SocketStream

from fibaction import GoalStatus
from fibaction.wire import messages
from fibaction.wire.codec import decode_from_server, encode
from fibaction.wire.frames import MAX_FRAME, FrameReader, header
from fibaction.words.goals import GoalID
from tests.tools.benchmarks.contender import AT_ONCE, PACED, Contender, messages_of
from tests.tools.benchmarks.inprocess import ACTION, Feedback, Goal, Result

CHUNK = 2**16
"""Bytes read or written at once, as over fibaction."""
NUMBER = 4
"""Bytes of the number of feedback messages that are wanted."""
CALL = 100_000
"""The ID of a call, and a goal's stamp, as many bytes long as they are after many goals."""
STAMP = 1_800_000_000_000_000_000


def framed(message: object) -> bytes:
    frame = encode(message)
    return header(len(frame)) + frame


REQUEST = framed(
    messages.SendGoal(
        CALL, ACTION.name, GoalID(bytes(range(16))), ACTION.goal.encode(Goal(0)), credit=0
    )
)
ANSWER = framed(
    messages.Following(CALL, STAMP, GoalStatus.EXECUTING, latest=False, place=0)
) + framed(messages.Ended(CALL, GoalStatus.SUCCEEDED, ACTION.result.encode(Result(0)), "", 0))


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


def without_delay(stream: SocketStream) -> None:
    raw = stream.extra(SocketAttribute.raw_socket)
    raw.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

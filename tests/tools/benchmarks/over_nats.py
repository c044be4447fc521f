"""NATS: a goal is a request, and all feedback and the result come to its inbox.

A server of NATS stands between the two. The payloads are the same as fibaction's, behind a byte
that says what they are. NATS holds no sender back, so the reader's buffers are as large as need be.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

from tests.support.nats_server import nats_server
from tests.tools.benchmarks.contender import Contender, messages_of
from tests.tools.benchmarks.inprocess import ACTION, Feedback, Goal, Result

SUBJECT = "count"
FEEDBACK, RESULT = b"f", b"r"
PATIENCE = 30.0
"""Seconds for an answer."""


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    import nats

    with nats_server("") as broker:
        url = f"nats://{broker.address}"
        client = await nats.connect(url)

        async def answer(request: Any) -> None:
            wanted = ACTION.goal.decode(request.data).count
            async for message in messages_of(wanted, Feedback):
                await request.respond(FEEDBACK + ACTION.feedback.encode(message))
            await request.respond(RESULT + ACTION.result.encode(Result(wanted)))

        await client.subscribe(SUBJECT, cb=answer)
        await client.flush()
        try:
            yield url
        finally:
            await client.close()


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    import nats

    client = await nats.connect(address)
    try:
        yield OverNats(client)
    finally:
        await client.close()


class OverNats(Contender):
    def __init__(self, client: Any) -> None:
        self._client = client

    async def goal(self) -> None:
        answer = await self._client.request(SUBJECT, ACTION.goal.encode(Goal(0)), timeout=PATIENCE)
        assert answer.data[:1] == RESULT
        ACTION.result.decode(answer.data[1:])

    async def numbers_of(self, goal: int) -> AsyncGenerator[list[int], None]:
        inbox = self._client.new_inbox()
        answers = await self._client.subscribe(
            inbox, pending_msgs_limit=goal + 1, pending_bytes_limit=2**30
        )
        await self._client.publish(SUBJECT, ACTION.goal.encode(Goal(goal)), reply=inbox)
        while True:
            answer = await answers.next_msg(timeout=PATIENCE)
            if answer.data[:1] == RESULT:
                break
            yield ACTION.feedback.decode(answer.data[1:]).numbers
        assert ACTION.result.decode(answer.data[1:]) == Result(goal)
        await answers.unsubscribe()

"""NATS alone, with the operations of JetStream that a fleet does for each goal.

A goal is a request to a queue group. The worker creates a record, which must be the first of its
subject, answers, replaces the record by one that says that the goal has ended and expires after a
while, and sends the result. Nothing is recovered here: this is the least that it costs.
"""

from __future__ import annotations

import math
import os
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
from anyio.streams.memory import MemoryObjectSendStream

from fibaction.cli.verbs.serve import rare_collections
from tests.tools.benchmarks.contender import Contender, messages_of
from tests.tools.benchmarks.inprocess import ACTION, Feedback, Goal, Result
from tests.tools.benchmarks.over_fibaction import FLEET
from tests.tools.benchmarks.over_nats import PATIENCE

STREAM = "BARE"
EXPECTED, TTL = "Nats-Expected-Last-Subject-Sequence", "Nats-TTL"
KEPT = "10s"
"""Time for which an ended goal is remembered, as long as a server of fibaction does by default."""
RECORD = bytes(180)
"""The rest of a record beside the payload, as large as a fleet's."""
FEEDBACK, RESULT = b"f", b"r"


def brokers() -> str:
    """Return the addresses of the brokers, from the URL of the fleet."""
    hosts = os.environ[FLEET].partition("//")[2].partition("/")[0]
    return ",".join(f"nats://{host}" for host in hosts.split(","))


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    import nats
    from nats.js.api import DiscardPolicy, StreamConfig

    where = brokers()
    client = await nats.connect(where.split(","))
    stream = client.jetstream(timeout=PATIENCE)
    await stream.add_stream(
        StreamConfig(
            name=STREAM,
            subjects=["bare.goal.*"],
            num_replicas=3 if "," in where else 1,
            max_msgs_per_subject=1,
            discard=DiscardPolicy.NEW,
            allow_direct=True,
            allow_msg_ttl=True,
        )
    )

    async def run(request: Any) -> None:
        goal_id, payload = request.data[:32].decode(), request.data[32:]
        wanted = ACTION.goal.decode(payload).count
        subject = f"bare.goal.{goal_id}"
        kept = await stream.publish(subject, RECORD + payload, headers={EXPECTED: "0"})
        await request.respond(b"accepted")
        down = f"bare.down.{request.headers['client']}.{goal_id}"
        async for message in messages_of(wanted, Feedback):
            await client.publish(down, FEEDBACK + ACTION.feedback.encode(message))
        result = ACTION.result.encode(Result(wanted))
        await stream.publish(subject, RECORD + result, headers={EXPECTED: str(kept.seq), TTL: KEPT})
        await client.publish(down, RESULT + result)

    with rare_collections():
        async with anyio.create_task_group() as tasks:

            async def start(request: Any) -> None:
                tasks.start_soon(run, request)

            await client.subscribe("bare.offer", queue="workers", cb=start)
            await client.flush()
            try:
                yield where
            finally:
                tasks.cancel_scope.cancel()
                await client.close()


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    import nats

    client = await nats.connect(address.split(","))
    contender = OverBareNats(client)
    await contender.open()
    try:
        yield contender
    finally:
        await client.close()


class OverBareNats(Contender):
    def __init__(self, client: Any) -> None:
        self._client = client
        self._name = os.urandom(8).hex()
        self._answers: dict[str, MemoryObjectSendStream[bytes]] = {}

    async def open(self) -> None:
        await self._client.subscribe(
            f"bare.down.{self._name}.*",
            cb=self._hear,
            pending_msgs_limit=1_000_000,
            pending_bytes_limit=2**30,
        )
        await self._client.flush()

    async def _hear(self, message: Any) -> None:
        self._answers[message.subject.rpartition(".")[2]].send_nowait(message.data)

    async def goal(self) -> None:
        async for _ in self.numbers_of(0):
            pass

    async def numbers_of(self, goal: int) -> AsyncGenerator[list[int], None]:
        goal_id = os.urandom(16).hex()
        self._answers[goal_id], answers = anyio.create_memory_object_stream[bytes](math.inf)
        await self._client.request(
            "bare.offer",
            goal_id.encode() + ACTION.goal.encode(Goal(goal)),
            timeout=PATIENCE,
            headers={"client": self._name},
        )
        with self._answers[goal_id], answers:
            while (answer := await answers.receive())[:1] == FEEDBACK:
                yield ACTION.feedback.decode(answer[1:]).numbers
            ACTION.result.decode(answer[1:])
        del self._answers[goal_id]

"""Every write of a goal's record, in the order in which the broker has stored them.

A fleet's stream keeps the newest record of each goal only. Here the broker is told to republish
each record that it has stored to another stream, which keeps all of them, with the time of each and
the sequence of the one that it has replaced. So a write that is missing here, because a broker was
killed after it had stored it, is noticed by the write after it.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager, suppress
from datetime import datetime
from typing import Any, NamedTuple

import anyio
import nats
from nats.js.api import RePublish, StreamConfig
from nats.js.errors import Error

from fibaction.goal_store import StoredGoal
from fibaction_transports.nats.fleet_records import goal_entry
from fibaction_transports.nats.names import FleetNames

NAME = "WITNESS"
PREFIX = "witness"
BATCH = 500


class Write(NamedTuple):
    """A record of a goal that the broker has stored."""

    at: float
    """Time at which it was stored: seconds since 1970."""
    sequence: int
    replaced: int
    """The sequence of the record before it; 0 if it is the goal's first."""
    goal: StoredGoal | None
    """None if the record was deleted, or has expired."""


class Witness:
    """A connection to the brokers beside the fleet's own."""

    def __init__(self, client: Any, fleet: str, replicas: int) -> None:
        self._client = client
        self._names = FleetNames(fleet)
        self._replicas = replicas

    async def begin(self) -> None:
        """Keep all writes from now on. The fleet's streams must be there."""
        stream = self._client.jetstream(timeout=10)
        await stream.add_stream(
            StreamConfig(name=NAME, subjects=[f"{PREFIX}.>"], num_replicas=self._replicas)
        )
        config = (await stream.stream_info(self._names.goals)).config
        config.republish = RePublish(src=">", dest=f"{PREFIX}.>")
        await stream.update_stream(config)

    async def leader(self, stream: str) -> str:
        """Return the name of the server that leads a stream: `goals`, `workers` or the witness."""
        name = {"goals": self._names.goals, "workers": self._names.workers}.get(stream, stream)
        cluster = (await self._client.jetstream(timeout=10).stream_info(name)).cluster
        return str(cluster.leader)

    async def lead_elsewhere(self, server: str) -> None:
        """Let another server lead the witness than the one that is about to be killed."""
        while await self.leader(NAME) == server:
            with suppress(nats.errors.TimeoutError):
                await self._client.request(f"$JS.API.STREAM.LEADER.STEPDOWN.{NAME}", b"", timeout=5)
            await anyio.sleep(0.1)

    async def writes(self) -> list[Write]:
        """Return all writes so far."""
        stream = self._client.jetstream(timeout=10)
        while True:  # a server may have to be found again after the last fault
            with suppress(Error, nats.errors.Error):
                total = (await stream.stream_info(NAME)).state.messages
                break
            await anyio.sleep(0.2)
        reader = await stream.pull_subscribe(f"{PREFIX}.>", stream=NAME)
        found: list[Write] = []
        while len(found) < total:
            for message in await reader.fetch(min(BATCH, total - len(found)), timeout=10):
                found.append(_write_of(message))
                await message.ack()
        await reader.unsubscribe()
        return sorted(found, key=lambda write: write.sequence)


def _write_of(message: Any) -> Write:
    headers = message.headers
    return Write(
        datetime.fromisoformat(headers["Nats-Time-Stamp"]).timestamp(),
        int(headers["Nats-Sequence"]),
        int(headers["Nats-Last-Sequence"]),
        goal_entry(message.data).goal if message.data else None,
    )


@asynccontextmanager
async def witness(urls: list[str], fleet: str) -> AsyncGenerator[Witness, None]:
    """Connect to the brokers while the block lasts."""

    async def ignore(_: Exception) -> None:
        pass

    client = await nats.connect(
        urls, max_reconnect_attempts=-1, reconnect_time_wait=0.1, error_cb=ignore
    )
    try:
        yield Witness(client, fleet, len(urls))
    finally:
        await client.close()

"""Every write of a goal's record, in the order in which the broker has stored them.

A fleet's stream keeps the newest record of each goal only. Here the broker is told to republish
each record that it has stored to another stream, which keeps all of them, with the time of each and
the sequence of the one that it has replaced. So a write that is missing here, because a broker was
killed after it had stored it, is noticed by the write after it. The newest record of each goal is
read from the fleet's stream as well.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from datetime import datetime
from typing import Any, NamedTuple, TypeVar

import anyio
import nats
from nats.js.api import RePublish, StreamConfig
from nats.js.errors import Error, NotFoundError

from fibaction.border.goal_store import StoredGoal
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import goal_entry, lease_entry

NAME = "WITNESS"
PREFIX = "witness"
BATCH = 500
PATIENCE = 60.0
"""Seconds within which brokers without faults answer."""

T = TypeVar("T")


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
        self._followed: dict[int, Write] = {}

    async def begin(self) -> None:
        """Keep all writes from now on. The fleet's streams must be there."""
        stream = self._client.jetstream(timeout=10)
        await stream.add_stream(
            StreamConfig(name=NAME, subjects=[f"{PREFIX}.>"], num_replicas=self._replicas)
        )
        config = (await stream.stream_info(self._names.goals)).config
        config.republish = RePublish(src=">", dest=f"{PREFIX}.>")
        await stream.update_stream(config)

    async def follow(self) -> None:
        """Read the writes while they are made, until canceled; needed with several brokers, because
        some of them do not republish any more when another one leads a stream.
        """
        reader: Any = None
        while self._replicas > 1:
            try:
                if reader is None:
                    stream = self._client.jetstream(timeout=5)
                    reader = await stream.pull_subscribe("", durable=NAME, stream=self._names.goals)
                for message in await reader.fetch(BATCH, timeout=1):
                    write = _newest(message)
                    self._followed[write.sequence] = write
                    await message.ack()
            except (Error, nats.errors.Error, TimeoutError):
                await anyio.sleep(0.1)

    async def leader(self, stream: str) -> str:
        """Return the name of the server that leads a stream of the fleet, or the witness."""
        names = self._names
        known = {"goals": names.goals, "workers": names.workers, "keys": names.keys}
        name = known.get(stream, stream)
        info = await _answer(self._client.jetstream(timeout=10).stream_info, name)
        return info.cluster.leader or ""

    async def incarnations(self, *workers: str) -> dict[str, bytes]:
        """Return the incarnations of these workers; one that has joined again has another."""
        found = {name: await _answer(self._lease, name) for name in workers}
        # While a lost worker is cleared up after, there is none.
        return {
            name: incarnation
            for name, data in found.items()
            if data and (incarnation := lease_entry(data).incarnation)
        }

    async def _lease(self, worker: str) -> bytes | None:
        subject = self._names.worker(worker)
        try:
            stream = self._client.jetstream(timeout=10)
            message = await stream.get_msg(self._names.workers, subject=subject, direct=False)
            data: bytes | None = message.data
        except NotFoundError:
            return None  # it has left
        return data

    async def lead_elsewhere(self, server: str) -> None:
        """Let another server lead the witness than the one that is about to be killed."""
        while await self.leader(NAME) in (server, ""):
            with suppress(nats.errors.TimeoutError):
                await self._client.request(f"$JS.API.STREAM.LEADER.STEPDOWN.{NAME}", b"", timeout=5)
            await anyio.sleep(0.5)

    async def writes(self) -> list[Write]:
        """Return all writes so far: those that were republished, and the newest of each goal."""
        found = self._followed | {
            write.sequence: write
            for name, write_of in ((self._names.goals, _newest), (NAME, _republished))
            for write in [write_of(one) for one in await _answer(self._read, name)]
        }
        return sorted(found.values(), key=lambda write: write.sequence)

    async def _read(self, name: str) -> list[Any]:
        stream = self._client.jetstream(timeout=10)
        total = (await stream.stream_info(name)).state.messages
        reader = await stream.pull_subscribe("", stream=name)
        try:
            found: list[Any] = []
            while len(found) < total:
                for message in await reader.fetch(min(BATCH, total - len(found)), timeout=10):
                    found.append(message)
                    await message.ack()
            return found
        finally:
            await reader.unsubscribe()


async def _answer(ask: Callable[[str], Awaitable[T]], name: str) -> T:
    """Ask for something by its name until the brokers answer, since they may have to find a leader
    first, of a stream or of a reader.

    Raises:
        TimeoutError: They have not answered within `PATIENCE`.
    """
    with anyio.fail_after(PATIENCE):
        while True:
            with suppress(Error, nats.errors.Error, TimeoutError):
                return await ask(name)
            await anyio.sleep(0.2)


def _republished(message: Any) -> Write:
    headers = message.headers
    return Write(
        datetime.fromisoformat(headers["Nats-Time-Stamp"]).timestamp(),
        int(headers["Nats-Sequence"]),
        int(headers["Nats-Last-Sequence"]),
        goal_entry(message.data).goal if message.data else None,
    )


def _newest(message: Any) -> Write:
    expected = (message.headers or {}).get("Nats-Expected-Last-Subject-Sequence", "0")
    return Write(
        message.metadata.timestamp.timestamp(),
        message.metadata.sequence.stream,
        int(expected),
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

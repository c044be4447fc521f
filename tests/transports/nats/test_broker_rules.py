"""The rules of the port `Broker`, for the real broker and for the one in memory of the tests."""

from __future__ import annotations

import math
import secrets
from collections.abc import AsyncGenerator
from contextlib import aclosing, asynccontextmanager
from typing import Any

import anyio
import msgspec
import pytest
from anyio import fail_after

from fibaction import TransportError
from fibaction._runtime.notify import Notifier
from fibaction_transports.nats.broker.broker import (
    Broker,
    BrokerAway,
    BrokerRecord,
    BrokerWatch,
    Message,
    NoResponders,
    PutError,
    PutFailure,
)
from fibaction_transports.nats.broker.client import MAX_QUEUED
from fibaction_transports.nats.broker.nats_broker import NatsBroker, open_broker
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.settings import FleetSettings
from tests.support.memory_broker import MemoryBrokers
from tests.support.nats_server import NatsServer, nats_cluster, needs_nats
from tests.transports.hearing import Hearing

pytestmark = pytest.mark.anyio
NAMES = FleetNames(secrets.token_hex(4))


@pytest.fixture(params=["memory", "real"])
async def brokers(request: Any) -> AsyncGenerator[tuple[Broker, Broker], None]:
    """Two members of a fleet."""
    if request.param == "memory":
        async with MemoryBrokers() as shared:
            yield shared.member(), shared.member()
        return
    server: NatsServer = request.getfixturevalue("shared_broker")
    settings = FleetSettings(NAMES.fleet, (server.address,))
    async with open_broker(settings) as one, open_broker(settings) as other:
        await one.create_streams(NAMES)
        yield one, other


def subject() -> str:
    return f"{NAMES.root}.goal.count.{secrets.token_hex(8)}"


async def put(
    broker: Broker, subject: str, data: bytes, expected: int = 0, ttl: float | None = None
) -> int | PutError:
    with fail_after(10):
        return await broker.put_and_wait(subject, data, expected=expected, ttl=ttl)


async def stored(
    broker: Broker, subject: str, data: bytes, expected: int = 0, ttl: float | None = None
) -> int:
    outcome = await put(broker, subject, data, expected, ttl)
    assert isinstance(outcome, int), outcome
    return outcome


async def assert_refused(broker: Broker, subject: str, expected: int) -> None:
    answer = await put(broker, subject, b"late", expected)
    assert isinstance(answer, PutError)
    assert answer.kind is PutFailure.REFUSED


async def first_of(watch: BrokerWatch) -> list[BrokerRecord]:
    """All records until the watch says that these were all."""
    records: list[BrokerRecord] = []
    with fail_after(15):
        while (batch := await watch.next()) is not None:
            records += batch
    return records


async def next_of(watch: BrokerWatch) -> BrokerRecord:
    with fail_after(10):
        records = await watch.next()
    assert records is not None
    (record,) = records
    return record


# Records


async def test_a_record_replaces_exactly_the_expected_one(brokers: tuple[Broker, Broker]) -> None:
    one, other = brokers
    name = subject()
    first = await stored(one, name, b"first")
    await assert_refused(other, name, 0)
    second = await stored(other, name, b"second", first)
    assert second > first
    await assert_refused(one, name, first)
    assert await one.get(NAMES.goals, name) == BrokerRecord(name, b"second", second)


async def test_a_subject_without_a_record_has_none(brokers: tuple[Broker, Broker]) -> None:
    one, _ = brokers
    name = subject()
    assert await one.get(NAMES.goals, name) is None
    await assert_refused(one, name, 7)


async def test_a_deleted_record_leaves_a_marker_to_write_over(
    brokers: tuple[Broker, Broker],
) -> None:
    one, other = brokers
    name = subject()
    marker = await stored(one, name, b"", await stored(one, name, b"first"), 60)
    assert await other.get(NAMES.goals, name) == BrokerRecord(name, b"", marker)
    await assert_refused(other, name, 0)
    assert await stored(other, name, b"second", marker) > marker


async def test_the_end_of_a_time_to_live_leaves_a_marker(brokers: tuple[Broker, Broker]) -> None:
    one, other = brokers
    name = subject()
    async with other.watch(NAMES.goals, name) as watch:
        assert await first_of(watch) == []
        sequence = await stored(one, name, b"first", ttl=1)
        assert await next_of(watch) == BrokerRecord(name, b"first", sequence)
        marker = await next_of(watch)
        assert marker.data == b""
        assert marker.sequence > sequence
    assert await one.get(NAMES.goals, name) == marker
    await stored(one, name, b"second", marker.sequence)


async def test_each_write_sets_the_time_to_live_anew(brokers: tuple[Broker, Broker]) -> None:
    one, other = brokers
    name = subject()
    sequence = await stored(one, name, b"first", ttl=1)
    async with other.watch(NAMES.goals, name) as watch:
        await first_of(watch)
        sequence = await stored(one, name, b"second", sequence)
        assert (await next_of(watch)).data == b"second"
        beside = subject()
        await stored(one, beside, b"beside", ttl=1)  # it ends later than the first one would have
        async with one.watch(NAMES.goals, beside) as ends:
            await first_of(ends)
            assert (await next_of(ends)).data == b""
        assert await one.get(NAMES.goals, name) == BrokerRecord(name, b"second", sequence)


async def test_a_record_that_is_too_large_is_told_apart(brokers: tuple[Broker, Broker]) -> None:
    one, _ = brokers
    name = subject()
    answer = await put(one, name, bytes(one.max_record + 1), 0)
    assert isinstance(answer, PutError)
    assert answer.kind is PutFailure.TOO_LARGE
    await stored(one, name, bytes(one.max_record))


async def test_an_answer_never_comes_within_the_call(brokers: tuple[Broker, Broker]) -> None:
    one, _ = brokers
    answers: list[int | PutError] = []
    for data in (b"small", bytes(one.max_record + 1)):
        one.put(subject(), data, expected=0, then=answers.append)
    assert not answers


# Watches


async def test_a_watch_begins_with_all_records_and_tells_their_end(
    brokers: tuple[Broker, Broker],
) -> None:
    one, other = brokers
    action = secrets.token_hex(4)
    names = [f"{NAMES.root}.goal.{action}.{number}" for number in range(5)]
    sequences = [await stored(one, name, name.encode()) for name in names]
    await stored(one, names[0], b"newest", sequences[0])
    async with other.watch(NAMES.goals, NAMES.goal(action)) as watch:
        found = await first_of(watch)
        assert [record.subject for record in found] == [*names[1:], names[0]]
        assert [record.sequence for record in found] == sorted(one.sequence for one in found)
        assert found[-1].data == b"newest"
        added = await stored(one, f"{NAMES.root}.goal.{action}.new", b"new")
        assert (await next_of(watch)).sequence == added


async def test_a_watch_sees_its_subjects_alone(brokers: tuple[Broker, Broker]) -> None:
    one, other = brokers
    name, beside = subject(), subject()
    async with other.watch(NAMES.goals, name) as watch:
        assert await first_of(watch) == []
        await stored(one, beside, b"beside")
        await stored(one, name, b"mine")
        assert (await next_of(watch)).data == b"mine"


# Messages


class Inbox:
    """The messages of a subscription."""

    def __init__(self) -> None:
        self.found: list[Message] = []
        self._news = Notifier()

    def take(self, message: Message) -> None:
        self.found.append(message)
        self._news.notify()

    async def count(self, count: int) -> list[Message]:
        with fail_after(10):
            while len(self.found) < count:
                await self._news.wait()
        return self.found


async def test_messages_come_in_order_to_all_that_listen(brokers: tuple[Broker, Broker]) -> None:
    one, other = brokers
    name = f"{NAMES.root}.up.{secrets.token_hex(4)}"
    inboxes = Inbox(), Inbox()
    await one.subscribe(f"{name}.*.>", inboxes[0].take)
    await other.subscribe(f"{name}.a.>", inboxes[1].take)
    await one.flush()
    await other.flush()
    for number in range(10):
        one.publish(f"{name}.a.b", str(number).encode())
    for inbox in inboxes:
        found = await inbox.count(10)
        assert [int(message.data) for message in found] == list(range(10))
        assert {message.subject for message in found} == {f"{name}.a.b"}


async def test_a_message_to_a_queue_goes_to_one_of_its_members(
    brokers: tuple[Broker, Broker],
) -> None:
    name = f"{NAMES.root}.offer.{secrets.token_hex(4)}"
    inboxes = Inbox(), Inbox()
    subscriptions = [
        await broker.subscribe(name, inbox.take, "group")
        for broker, inbox in zip(brokers, inboxes, strict=True)
    ]
    for broker in brokers:
        await broker.flush()
    for _ in range(20):
        brokers[0].publish(name, b"")
    await brokers[0].flush()  # what goes to this member has come
    subscriptions[0].close()
    subscriptions[0].close()
    closed = len(inboxes[0].found)
    for _ in range(20):
        brokers[0].publish(name, b"")
    await inboxes[1].count(40 - closed)
    assert len(inboxes[0].found) == closed


async def test_a_request_gets_the_answer(brokers: tuple[Broker, Broker]) -> None:
    one, other = brokers
    name = f"{NAMES.root}.offer.{secrets.token_hex(4)}"
    await other.subscribe(name, lambda asked: other.publish(asked.reply, asked.data + b"!"))
    await other.flush()
    assert await one.request(name, b"hello", 5) == b"hello!"


async def test_a_sender_is_told_that_has_no_responders(brokers: tuple[Broker, Broker]) -> None:
    one, _ = brokers
    name, back = f"{NAMES.root}.up.{secrets.token_hex(4)}", f"{NAMES.root}.down.x.1"
    with pytest.raises(NoResponders):
        await one.request(name, b"hello", 5)
    inbox = Inbox()
    await one.subscribe(back, inbox.take)
    one.publish(name, b"hello", back)
    (message,) = await inbox.count(1)
    assert message.has_no_responders
    assert message.subject == back


# Notes


async def test_each_note_is_taken_once_and_in_order(brokers: tuple[Broker, Broker]) -> None:
    one, other = brokers
    name = NAMES.want(secrets.token_hex(4))
    for number in range(4):
        one.add_note(name, str(number).encode())
    await one.flush()
    found: list[int] = []
    async with aclosing(one.notes(name)) as mine, aclosing(other.notes(name)) as others:
        with fail_after(20):
            for notes in (mine, others, mine, others):
                note = await anext(notes)
                found.append(int(note.data))
                note.done()
    assert found == list(range(4))


async def test_a_note_that_was_not_removed_comes_again(brokers: tuple[Broker, Broker]) -> None:
    one, other = brokers
    name = NAMES.left(secrets.token_hex(4))
    one.add_note(name, b"again")
    async with aclosing(one.notes(name)) as mine, aclosing(other.notes(name)) as others:
        with fail_after(20):
            assert (await anext(mine)).data == b"again"
            note = await anext(others)
            assert note.data == b"again"
            note.done()


# The broker on a real nats-server


def settings_of(server: NatsServer, fleet: str = "fleet") -> FleetSettings:
    return FleetSettings(fleet, (server.address,))


@asynccontextmanager
async def opened(server: NatsServer, fleet: str) -> AsyncGenerator[NatsBroker, None]:
    """A broker with the streams of a fleet."""
    async with open_broker(settings_of(server, fleet)) as broker:
        await broker.create_streams(FleetNames(fleet))
        yield broker


async def until(watch: BrokerWatch, data: bytes) -> list[BrokerRecord]:
    """All records until one with this data."""
    records: list[BrokerRecord] = []
    with fail_after(30):
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


@needs_nats
async def test_three_brokers_lose_nothing_when_the_leader_is_killed(
    log: Hearing, fleet: str
) -> None:
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
                with fail_after(40):  # an election takes 4 to 9 s when it is quiet
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
                with fail_after(10):
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
    with fail_after(10):
        async with open_broker(settings_of(own_broker)):
            own_broker.kill()
            await log.until("is lost")

"""The rules of the port `Broker`, for the real broker and for the one in memory of the tests."""

from __future__ import annotations

import secrets
from collections.abc import AsyncGenerator
from contextlib import aclosing
from typing import Any

import pytest
from anyio import fail_after

from fibaction._runtime.notify import Notifier
from fibaction_transports.nats.broker.broker import (
    Broker,
    BrokerRecord,
    BrokerWatch,
    Message,
    NoResponders,
    PutError,
    PutFailure,
)
from fibaction_transports.nats.broker.nats_broker import open_broker
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.settings import FleetSettings
from tests.support.memory_broker import MemoryBrokers
from tests.support.nats_server import NatsServer

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
    broker: Broker, subject: str, data: bytes, expected: int, ttl: float | None = None
) -> int | PutError:
    with fail_after(10):
        return await broker.put_and_wait(subject, data, expected=expected, ttl=ttl)


async def stored(
    broker: Broker, subject: str, data: bytes, expected: int = 0, ttl: float | None = None
) -> int:
    answer = await put(broker, subject, data, expected, ttl)
    assert isinstance(answer, int), answer
    return answer


async def assert_refused(broker: Broker, subject: str, expected: int) -> None:
    answer = await put(broker, subject, b"late", expected)
    assert isinstance(answer, PutError)
    assert answer.kind is PutFailure.REFUSED


async def all_of(watch: BrokerWatch) -> list[BrokerRecord]:
    found: list[BrokerRecord] = []
    with fail_after(10):
        while (records := await watch.next()) is not None:
            found += records
    return found


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
        assert await all_of(watch) == []
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
        await all_of(watch)
        sequence = await stored(one, name, b"second", sequence)
        assert (await next_of(watch)).data == b"second"
        beside = subject()
        await stored(one, beside, b"beside", ttl=1)  # it ends later than the first one would have
        async with one.watch(NAMES.goals, beside) as ends:
            await all_of(ends)
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
        found = await all_of(watch)
        assert [record.subject for record in found] == [*names[1:], names[0]]
        assert [record.sequence for record in found] == sorted(one.sequence for one in found)
        assert found[-1].data == b"newest"
        added = await stored(one, f"{NAMES.root}.goal.{action}.new", b"new")
        assert (await next_of(watch)).sequence == added


async def test_a_watch_sees_its_subjects_alone(brokers: tuple[Broker, Broker]) -> None:
    one, other = brokers
    name, beside = subject(), subject()
    async with other.watch(NAMES.goals, name) as watch:
        assert await all_of(watch) == []
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

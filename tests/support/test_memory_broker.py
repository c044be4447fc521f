"""The faults of the broker in memory; its rules are in `test_broker_rules`."""

from __future__ import annotations

from contextlib import aclosing

import anyio.lowlevel
import pytest
from anyio import current_time, fail_after, move_on_after, sleep

from fibaction_transports.nats.broker.broker import (
    BrokerAway,
    BrokerRecord,
    Message,
    PutError,
    PutFailure,
)
from fibaction_transports.nats.names import FleetNames
from tests.support.memory_broker import MemoryBroker, MemoryBrokers, Write
from tests.support.virtual_time import in_virtual_time

pytestmark = [pytest.mark.anyio, in_virtual_time()]
NAMES = FleetNames("test")
GOAL = f"{NAMES.root}.goal.count.1"


def put(
    broker: MemoryBroker, data: bytes, expected: int = 0, ttl: float | None = None
) -> list[int | PutError]:
    answers: list[int | PutError] = []
    broker.put(GOAL, data, expected=expected, ttl=ttl, then=answers.append)
    return answers


def kind_of(answers: list[int | PutError]) -> PutFailure:
    (answer,) = answers
    assert isinstance(answer, PutError)
    return answer.kind


async def test_a_member_that_is_away_gets_no_answers() -> None:
    async with MemoryBrokers() as shared:
        member = shared.member()
        member.is_away = True
        assert not member.is_connected
        answers = put(member, b"lost")
        await sleep(1.9)
        assert not answers
        await sleep(0.2)
        assert kind_of(answers) is PutFailure.UNKNOWN
        for ask in (
            member.get(NAMES.goals, GOAL),
            member.flush(),
            member.subscribe(GOAL, lambda _: None),
            member.watch(NAMES.goals, GOAL).__aenter__(),
        ):
            with pytest.raises(BrokerAway):
                await ask
        member.is_away = False
        assert await member.get(NAMES.goals, GOAL) is None


async def test_an_answer_can_be_lost_after_the_record_is_stored() -> None:
    async with MemoryBrokers() as shared:
        member = shared.member("robot")
        shared.loses_answer = lambda write: write == Write("robot", GOAL, b"stored")
        answers = put(member, b"stored")
        await sleep(3)
        assert kind_of(answers) is PutFailure.UNKNOWN
        assert await member.get(NAMES.goals, GOAL) == BrokerRecord(GOAL, b"stored", 1)
        assert [write.data for write in shared.writes] == [b"stored"]


async def test_a_full_stream_stores_nothing() -> None:
    async with MemoryBrokers() as shared:
        member = shared.member()
        shared.is_full = True
        answers = put(member, b"lost")
        await anyio.lowlevel.checkpoint()
        assert await member.get(NAMES.goals, GOAL) is None
        assert kind_of(answers) is PutFailure.FULL


async def test_what_is_sent_arrives_later_and_in_order() -> None:
    async with MemoryBrokers() as shared:
        member = shared.member()
        delays = iter((5.0, 1.0, 0.0))
        shared.delay = lambda: next(delays)
        began = current_time()
        first, second = put(member, b"first"), put(member, b"second", 1)
        with fail_after(6):
            await member.flush()
        assert current_time() - began == pytest.approx(5)
        assert (first, second) == ([1], [2])


async def test_a_watch_begins_anew_after_a_restart_and_after_an_absence() -> None:
    async with MemoryBrokers() as shared:
        member, other = shared.member(), shared.member()
        put(other, b"first")
        await other.flush()
        async with member.watch(NAMES.goals, GOAL) as watch:
            first = [BrokerRecord(GOAL, b"first", 1)]
            assert [await watch.next(), await watch.next()] == [first, None]
            shared.restart()
            assert [await watch.next(), await watch.next()] == [first, None]
            member.is_away = True
            put(other, b"second", 1)
            await other.flush()
            with move_on_after(10):
                raise AssertionError(await watch.next())
            member.is_away = False
            second = [BrokerRecord(GOAL, b"second", 2)]
            assert [await watch.next(), await watch.next()] == [second, None]


async def test_messages_pass_by_members_that_are_away() -> None:
    async with MemoryBrokers() as shared:
        member, other = shared.member(), shared.member()
        found: list[Message] = []
        await member.subscribe("fib.x", found.append, "group")
        await other.subscribe("fib.x", found.append, "group")
        member.is_away = True
        other.publish("fib.x", b"1")
        member.publish("fib.x", b"lost")
        await other.flush()
        assert [message.data for message in found] == [b"1"]
        with pytest.raises(BrokerAway):
            await other.request("fib.x", b"2", 1)  # nobody answers


async def test_notes_wait_for_a_member_that_is_away() -> None:
    async with MemoryBrokers() as shared:
        member, other = shared.member(), shared.member()
        member.is_away = other.is_away = True
        member.add_note("fib.test.want.x", b"note")
        async with aclosing(other.notes("fib.test.want.x")) as notes:
            with move_on_after(10):
                raise AssertionError(await anext(notes))
        member.is_away = other.is_away = False
        async with aclosing(other.notes("fib.test.want.x")) as notes:
            with fail_after(10):
                note = await anext(notes)
            other.is_away = True
            note.done()
            assert [one.data for one in shared.notes] == [b"note"]
            other.is_away = False
            note.done()
            note.done()
            assert not shared.notes

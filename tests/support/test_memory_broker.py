"""The faults of the broker in memory; its rules are in `test_broker_rules`."""

from __future__ import annotations

import pytest
from anyio import move_on_after, sleep

from fibaction_transports.nats.broker.broker import (
    BrokerAway,
    BrokerRecord,
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

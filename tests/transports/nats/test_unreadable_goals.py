"""The goals that a worker cannot run, and that it leaves to others."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import pytest
from anyio import sleep

from fibaction.border.event_loop import Background
from fibaction_transports.nats.broker.broker import BrokerAway, BrokerSubscription, Message
from fibaction_transports.nats.worker import unreadable_goals
from fibaction_transports.nats.worker.lease import LONGEST_PAUSE, Membership
from tests.support.memory_broker import MemoryBroker, MemoryBrokers
from tests.support.virtual_time import in_virtual_time
from tests.transports.hearing import Hearing
from tests.transports.nats.members import (
    LEASE,
    NAMES,
    ServesCount,
    entry,
    keep,
    member,
    waiting,
)

pytestmark = [pytest.mark.anyio, in_virtual_time()]
IN_TURN = 30 * unreadable_goals.HOLD
"""Seconds in which a reader gets a note that another one takes as well, by chance."""
CANNOT_RUN = (
    f"1 goal of 'count' without a worker cannot run at this one, for example {'01' * 16}: it"
    f" has no field `unit`; start a worker of the version that accepted them, or end them with"
    f" unreadable='abort'"
)


async def test_a_goal_that_no_living_worker_can_run_waits_for_one_that_can(log: Hearing) -> None:
    async with MemoryBrokers() as shared:
        for number in (1, 2, 3):
            keep(shared, waiting(number))
        async with member(shared, "b") as b:
            b.cannot_run = {waiting(1).goal_id}
            await b.claims(2, within=1)
            await sleep(30 * LEASE)
            assert log.warnings == [CANNOT_RUN]
            assert entry(shared, waiting(1)).goal == waiting(1)
            async with member(shared, "c") as c:
                await c.claims(1, within=IN_TURN)
            assert len(b.claimed) == 2


async def test_many_goals_are_remembered_up_to_a_number(
    log: Hearing, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(unreadable_goals, "MOST_KNOWN", 2)
    async with MemoryBrokers() as shared, member(shared, "b") as b:
        b.cannot_run = {waiting(number).goal_id for number in (1, 2, 3)}
        for number in (1, 2, 3):
            keep(shared, waiting(number))
            b.broker.add_note(NAMES.left("count"), bytes(waiting(number).goal_id))
        await sleep(10 * LEASE)
        assert b.journals.unreadable == {"count": 2}


# Their number


async def test_the_number_is_told_once_in_the_log_and_in_the_lease(log: Hearing) -> None:
    async with MemoryBrokers() as shared:
        goals = [waiting(number) for number in range(1, 5)]
        for one in goals[:3]:
            keep(shared, one)
        async with member(shared, "b", cannot_run=goals) as b:
            await sleep(2 * LEASE)
            assert b.journals.unreadable == {"count": 3}
            keep(shared, waiting(4))
            b.broker.add_note(NAMES.left("count"), bytes(waiting(4).goal_id))
            await sleep(2 * LEASE)
            assert [one.partition(" of ")[0] for one in log.warnings] == ["3 goals", "4 goals"]
            b.cannot_run = {waiting(4).goal_id}
            await b.claims(3, within=30 * LEASE)
            await sleep(2 * LEASE)
            assert b.journals.unreadable == {"count": 1}
            assert len(log.warnings) == 2, "fewer of them are no news"
            b.cannot_run.clear()
            await b.claims(4, within=30 * LEASE)
            await sleep(2 * LEASE)
            assert b.journals.unreadable == {"count": 0}
    assert log.warnings[2:] == ["all goals of 'count' have a worker again, or have ended"]


async def test_it_is_told_again_when_the_brokers_answer_again() -> None:
    async with MemoryBrokers() as shared:
        keep(shared, waiting())
        async with member(shared, "b", cannot_run=[waiting()]) as b:
            await sleep(0.1)
            b.broker.is_away = True
            await sleep(LEASE)
            assert b.journals.unreadable == {}
            b.broker.is_away = False
            await sleep(3 * LEASE)
            assert b.journals.unreadable == {"count": 1}
            shared.put(NAMES.goal("count", waiting().goal_id), b"", 1, 60)
            await sleep(2 * LEASE)
            assert b.journals.unreadable == {"count": 0}


# Their end


async def test_goals_that_no_worker_can_run_wait_ten_leases_for_their_end(log: Hearing) -> None:
    async with MemoryBrokers() as shared:
        goals = [waiting(number) for number in range(1, 101)]
        for one in goals:
            keep(shared, one)
        async with (
            member(shared, "b", cannot_run=goals, ends_unreadable=True) as b,
            member(shared, "c", cannot_run=goals, ends_unreadable=True) as c,
        ):
            await sleep(9 * LEASE)
            assert not b.claimed
            assert not c.claimed
            await sleep(5 * LEASE)
            taken = sorted(one.stamp for one in b.claimed + c.claimed)
            assert taken == list(range(1, 101))
    assert any("or they are ended" in one for one in log.warnings)


@asynccontextmanager
async def other_worker(
    shared: MemoryBrokers, answer: bytes | None
) -> AsyncGenerator[list[bytes], None]:
    """Let another worker live, which answers questions; with None, it is of an older release."""
    broker = shared.member("other")
    membership = Membership(broker, NAMES, "other", LEASE)
    membership.add(ServesCount())
    await membership.join()
    asked: list[bytes] = []

    def on_question(message: Message) -> None:
        asked.append(message.data)
        if answer:
            broker.publish(message.reply, answer)

    if answer is not None:
        await broker.subscribe(NAMES.reads("other", "count"), on_question)
    async with Background() as tasks:
        tasks.start_soon(membership.run)
        yield asked


@pytest.mark.parametrize("answer", [None, b"", unreadable_goals.CAN_RUN])
async def test_a_goal_that_another_worker_may_be_able_to_run_is_left_to_it(
    answer: bytes | None,
) -> None:
    async with MemoryBrokers() as shared, other_worker(shared, answer) as asked:
        keep(shared, waiting())
        async with member(shared, "b", cannot_run=[waiting()], ends_unreadable=True) as b:
            await sleep(20 * LEASE)
            assert not b.claimed
            assert bool(asked) == (answer is not None)


async def test_a_worker_says_whether_it_can_run_a_goal() -> None:
    async with MemoryBrokers() as shared, member(shared, "b") as b:
        keep(shared, waiting(1), b"12345678")
        b.cannot_run = {waiting(1).goal_id}
        asking, subject = shared.member(), NAMES.reads("b", "count")

        async def answer(question: bytes) -> bytes:
            return await asking.request(subject, question, 1)

        assert await answer(bytes(waiting(1).goal_id)) == unreadable_goals.CANNOT_RUN
        assert await answer(bytes(waiting(2).goal_id)) == unreadable_goals.CANNOT_RUN, "unknown"
        b.cannot_run = set()
        assert await answer(bytes(waiting(1).goal_id)) == unreadable_goals.CAN_RUN
        with pytest.raises(BrokerAway):
            await answer(b"no goal ID")


async def test_questions_are_heard_as_soon_as_the_brokers_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    subscribe, failures = MemoryBroker.subscribe, [BrokerAway("away")]

    async def failing(self: MemoryBroker, subject: str, *args: Any) -> BrokerSubscription:
        if ".reads." in subject and failures:
            raise failures.pop()
        return await subscribe(self, subject, *args)

    monkeypatch.setattr(MemoryBroker, "subscribe", failing)
    async with MemoryBrokers() as shared, member(shared, "b"):
        await sleep(LONGEST_PAUSE + 1)
        answer = await shared.member().request(NAMES.reads("b", "count"), bytes(16), 1)
        assert answer == unreadable_goals.CANNOT_RUN

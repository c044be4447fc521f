"""The goals that come to a worker from others: lost, released, or waiting there."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import pytest
from anyio import sleep
from msgspec.structs import replace

from fibaction import GoalID, GoalStatus
from fibaction_transports.nats.broker.broker import (
    BrokerAway,
    BrokerRecord,
    BrokerStream,
    BrokerSubscription,
    Message,
)
from fibaction_transports.nats.records import GoalEntry, encode, lease_entry
from fibaction_transports.nats.worker import unreadable_goals
from fibaction_transports.nats.worker.lease import LONGEST_PAUSE, Membership
from fibaction_transports.nats.worker.takeover import SCAN_INTERVAL
from tests.support.memory_broker import MemoryBroker, MemoryBrokers, Write
from tests.support.virtual_time import in_virtual_time
from tests.transports.hearing import Hearing
from tests.transports.nats.members import (
    LEASE,
    NAMES,
    ServesCount,
    entry,
    goal,
    keep,
    member,
    staying,
    waiting,
)

pytestmark = [pytest.mark.anyio, in_virtual_time()]
# Lost workers


async def test_one_survivor_clears_up_and_then_removes_the_lease(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with MemoryBrokers() as shared, member(shared, "b"), member(shared, "c"):
        with caplog.at_level(logging.WARNING, "fibaction.nats"):
            lost = Membership(shared.member("a"), NAMES, "a", LEASE)
            await lost.join()
            await sleep(LEASE + 1)
        assert caplog.text.count("worker 'a' is gone; its goals are taken over") == 1
        entries = [
            lease_entry(write.data)
            for write in shared.writes
            if write.subject == NAMES.worker("a") and write.data
        ]
        assert [(bool(one.incarnation), bool(one.cleared_by)) for one in entries] == [
            (True, False),
            (False, True),
            (False, False),
        ]


async def test_clearing_up_that_was_interrupted_is_done_when_its_claim_ends() -> None:
    async with MemoryBrokers() as shared, member(shared, "b") as b:
        lost = Membership(shared.member("a"), NAMES, "a", LEASE)
        await lost.join()
        other = NAMES.goal("other", goal().goal_id)
        shared.put(other, encode(GoalEntry(goal(worker="a"), lost.incarnation, b"")), 0, 9e9)
        cuts = [1]

        async def away(call: str, subject: str) -> None:
            if (call, subject) == ("watch", NAMES.all_goals()) and cuts:
                cuts.pop()
                raise BrokerAway("on purpose")

        b.broker.before = away
        await sleep(LEASE + 3)
        assert not cuts
        assert not shared.notes
        await sleep(LEASE)
        assert [note.subject for note in shared.notes] == [NAMES.left("other")]


async def test_the_claim_of_a_name_that_is_used_again_is_not_touched() -> None:
    async with MemoryBrokers() as shared, member(shared, "b") as b:
        lost = Membership(shared.member("a"), NAMES, "a", LEASE)
        await lost.join()
        records: list[BrokerRecord | None] = []

        async def other(call: str, subject: str) -> None:
            if (call, subject) == ("watch", NAMES.all_goals()):
                claim = shared.newest(NAMES.worker("a"))
                assert claim is not None
                shared.put(claim.subject, b"of a later version", claim.sequence, 9e9)
                records.append(shared.newest(claim.subject))

        b.broker.before = other
        await sleep(2 * LEASE)
        assert records == [shared.newest(NAMES.worker("a"))]


# Scans


async def test_a_worker_finds_goals_without_an_owner_when_it_starts() -> None:
    async with MemoryBrokers() as shared:
        keep(shared, goal(1, worker="gone"), b"gone")
        keep(shared, waiting(2))
        keep(shared, goal(3, status=GoalStatus.SUCCEEDED, worker="gone"), b"gone")
        shared.put(NAMES.goal("count", goal(4).goal_id), b"rubbish", 0, 9e9)
        shared.put(
            NAMES.goal("other", goal(5).goal_id), encode(GoalEntry(goal(5), b"", b"")), 0, 9e9
        )
        async with member(shared, "b") as b:
            found = await b.claims(2, within=1)
            assert sorted(one.stamp for one in found) == [1, 2]
            await sleep(LEASE)
            assert len(b.claimed) == 2


async def test_late_writes_of_a_lost_worker_are_found_in_the_end() -> None:
    async with MemoryBrokers() as shared, member(shared, "b") as b:
        await sleep(1)
        keep(shared, goal(worker="gone"), b"gone")
        await b.claims(1, within=(SCAN_INTERVAL + 1) * LEASE)


async def test_a_worker_whose_lease_is_not_known_yet_is_asked_for() -> None:
    async with MemoryBrokers() as shared, member(shared, "b") as b:
        b.broker.watch_delay = 2
        new = Membership(shared.member("a"), NAMES, "a", LEASE)
        await new.join()
        keep(shared, goal(worker="a"), new.incarnation)
        b.broker.add_note(NAMES.left("count"), bytes(goal().goal_id))
        await sleep(1)
        assert not b.claimed
        assert not shared.notes


async def test_an_unreadable_lease_is_not_judged() -> None:
    async with MemoryBrokers() as shared, member(shared, "b") as b:
        shared.put(NAMES.worker("a"), b"rubbish", 0, 9e9)
        keep(shared, goal(worker="a"), b"a")
        b.broker.add_note(NAMES.left("count"), bytes(goal().goal_id))
        await sleep(1)
        assert not b.claimed


async def test_no_worker_is_gone_while_the_stream_of_the_leases_is_new() -> None:
    async with MemoryBrokers() as shared:
        shared.stream = BrokerStream("second", LEASE - 1)
        keep(shared, goal(worker="gone"), b"gone")
        async with member(shared, "b") as b:
            await sleep(2 * LEASE)
            assert not b.claimed
            shared.stream = BrokerStream("second", LEASE)
            await b.claims(1, within=2)


# Notes of goals without a worker


async def test_a_released_goal_is_taken_also_without_room() -> None:
    async with MemoryBrokers() as shared:
        async with member(shared, "b", running=0) as b:
            async with member(shared, "a") as a:
                a.accept(waiting())  # it is released when the server stops
            assert await b.claims(1, within=1) == [waiting()]


async def test_notes_of_goals_that_are_not_lost_are_removed() -> None:
    async with MemoryBrokers() as shared, member(shared, "a") as a, member(shared, "b") as b:
        a.accept(goal(1))
        b.accept(goal(2))
        deleted = goal(3)
        shared.put(NAMES.goal("count", deleted.goal_id), b"", 0, 9e9)
        known = [bytes(one.goal_id) for one in (goal(1), goal(2), deleted)]
        for note in (*known, bytes(16), b"rubbish"):
            a.broker.add_note(NAMES.left("count"), note)
        await sleep(2)
        assert not shared.notes
        assert not a.claimed + b.claimed


@pytest.mark.parametrize("subject", [NAMES.left("count"), NAMES.want("count")])
async def test_a_note_comes_again_if_its_goal_cannot_be_read(subject: str) -> None:
    cuts = [1]

    async def away(call: str, of: str) -> None:
        if call == "get" and of == NAMES.goal("count", goal().goal_id) and cuts:
            cuts.pop()
            raise BrokerAway("on purpose")

    async with MemoryBrokers() as shared, member(shared, "b", running=1) as b:
        await sleep(1)
        keep(shared, waiting())
        b.broker.before = away
        b.broker.add_note(subject, bytes(goal().goal_id))
        await sleep(1)
        assert not cuts
        assert not b.claimed
        assert await b.claims(1, within=12)


# Notes of goals that wait


async def test_a_waiting_goal_runs_at_a_worker_as_soon_as_that_has_room() -> None:
    async with MemoryBrokers() as shared:
        async with member(shared, "a") as a, member(shared, "b") as b:
            a.accept(waiting())
            await sleep(2 * LEASE)
            assert not b.claimed
            b.journal.set_capacity(1, 0)
            assert await b.claims(1, within=1) == [replace(waiting(), worker="a")]
            await sleep(0.5)
            assert a.lost == [waiting().goal_id], "it has got a hint"
            assert entry(shared, goal()).goal.worker == "b"
            assert not shared.notes


async def test_notes_of_goals_that_do_not_wait_are_removed() -> None:
    async with MemoryBrokers() as shared:
        async with member(shared, "a") as a, member(shared, "b", running=9) as b:
            a.accept(goal(1))
            keep(shared, goal(2, is_running=False, status=GoalStatus.CANCELING), b"x")
            for note in (bytes(goal(1).goal_id), bytes(goal(2).goal_id), bytes(16), b"rubbish"):
                a.broker.add_note(NAMES.want("count"), note)
            await sleep(2)
            assert not shared.notes
            assert goal(1).goal_id not in {one.goal_id for one in b.claimed}


async def test_a_taken_goal_that_does_not_begin_is_offered_to_others() -> None:
    async with MemoryBrokers() as shared:
        async with member(shared, "a") as a, member(shared, "b", running=1) as b:
            b.begins = False
            a.accept(waiting())
            await b.claims(1, within=1)
            b.journal.set_capacity(0, 0)
            async with member(shared, "c", running=1) as c:
                await c.claims(1, within=4)
                await sleep(0.1)  # the hint comes later
                assert b.lost == [waiting().goal_id]


async def test_a_suspect_that_waits_until_it_can_run_alone_is_not_offered_to_others() -> None:
    async with MemoryBrokers() as shared:
        async with member(shared, "a") as a, member(shared, "b", running=1) as b:
            a.accept(replace(waiting(), attempt=2, lost=2))
            await sleep(4)
            assert not b.claimed


# Hints


async def test_a_hint_alone_takes_no_goal_away() -> None:
    async with MemoryBrokers() as shared, member(shared, "a") as a:
        other = shared.member()
        a.accept(waiting())
        await sleep(0.1)
        subject = NAMES.goal("count", waiting().goal_id)
        unknown = NAMES.goal("count", GoalID(bytes(16)))
        for hint in (subject, unknown, NAMES.goal("x", goal().goal_id), "x", "ä", f"{subject}x"):
            other.publish(NAMES.taken("a"), hint.encode())
        await sleep(1)
        assert not a.lost


async def test_a_hint_is_ignored_while_the_brokers_do_not_answer() -> None:
    async def away(call: str, _subject: str) -> None:
        if call == "get":
            raise BrokerAway("on purpose")

    async with MemoryBrokers() as shared, member(shared, "a") as a:
        a.accept(waiting())
        await sleep(0.1)
        a.broker.before = away
        shared.member().publish(NAMES.taken("a"), NAMES.goal("count", waiting().goal_id).encode())
        await sleep(1)
        assert not a.lost


async def test_a_note_comes_again_if_the_worker_is_fenced_while_it_takes_the_goal() -> None:
    async with MemoryBrokers() as shared, member(shared, "a", running=9) as a:
        await sleep(1)
        for number, subject in ((1, NAMES.left("count")), (2, NAMES.want("count"))):
            keep(shared, waiting(number))
            a.broker.add_note(subject, bytes(goal(number).goal_id))
        first = a.membership.incarnation

        def fence(write: Write) -> bool:
            if first == a.membership.incarnation and ".goal." in write.subject:
                a.membership._fence("on purpose")
            return False

        shared.loses_answer = fence
        found = await a.claims(2, within=20)
        assert sorted(one.stamp for one in found) == [1, 2]
        assert a.membership.incarnation not in (b"", first)


async def test_a_note_that_comes_when_there_is_no_room_any_more_is_given_back() -> None:
    async with MemoryBrokers() as shared:
        async with member(shared, "a") as a, member(shared, "b", running=1) as b:
            await sleep(1)
            b.journal.set_capacity(0, 0)
            a.accept(waiting())
            await sleep(1)
            assert not b.claimed
            assert len(shared.notes) == 1
            async with member(shared, "c", running=1) as c:
                await c.claims(1, within=1)


async def test_a_note_of_a_goal_that_waits_here_comes_again() -> None:
    async with MemoryBrokers() as shared, member(shared, "a", running=1) as a:
        a.accept(waiting())
        await sleep(2)
        assert len(shared.notes) == 1
        a.journal.begin(goal(), lambda _error: None)
        await sleep(10)
        assert not shared.notes
        assert not a.claimed


# The goals that a worker cannot run, and that it leaves to others


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
    asked: list[bytes] = []

    def on_question(message: Message) -> None:
        asked.append(message.data)
        if answer:
            broker.publish(message.reply, answer)

    if answer is not None:
        await broker.subscribe(NAMES.reads("other", "count"), on_question)
    async with staying(membership):
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

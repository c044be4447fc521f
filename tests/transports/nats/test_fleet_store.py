"""The records of goals: who may write them, in which order, and what becomes of doubtful writes."""

from __future__ import annotations

import time

import anyio
import pytest
from anyio import create_task_group, sleep
from msgspec.structs import replace

from fibaction import GoalStatus, TransportError
from fibaction.border.goal_store import (
    GoalTaken,
    RecordTooLarge,
    StoredGoal,
    StoreFull,
)
from fibaction.words.errors import StoreError
from fibaction_transports.nats.broker.broker import BrokerRecord
from fibaction_transports.nats.records import GoalEntry, encode, goal_entry
from fibaction_transports.nats.worker import journal, record_writes
from fibaction_transports.nats.worker.lease import FIRST_PAUSE
from tests.support.memory_broker import MemoryBrokers, Write
from tests.support.virtual_time import in_virtual_time
from tests.transports.nats.members import LEASE, NAMES, Member, entry, goal, member

pytestmark = [pytest.mark.anyio, in_virtual_time()]


def ended(one: StoredGoal, keep_until: int = 0) -> StoredGoal:
    return replace(
        one,
        status=GoalStatus.SUCCEEDED,
        is_running=False,
        goal=b"",
        result=b"result",
        ended_at=time.time_ns(),
        keep_until=keep_until,
    )


def is_kept(shared: MemoryBrokers, one: StoredGoal) -> bool:
    record = shared.newest(NAMES.goal("count", one.goal_id))
    return record is not None and bool(record.data)


def writes(shared: MemoryBrokers) -> list[Write]:
    return [write for write in shared.writes if ".goal." in write.subject]


# Writes


async def test_a_goal_is_kept_from_its_acceptance_to_its_end() -> None:
    async with MemoryBrokers() as shared, member(shared) as robot:
        one = goal()
        robot.write("accept", one)
        assert not robot.answers, "an answer came within the call"
        await robot.answered(1)
        found = entry(shared, one)
        assert found.incarnation == robot.membership.incarnation
        assert found.goal == replace(one, worker="robot")
        assert len(robot.journal) == 1
        robot.write("end", ended(one))
        await robot.answered(2)
        assert robot.errors == [None, None]
        found = entry(shared, one)
        assert found.goal == replace(ended(one), worker="robot", ended_at=found.goal.ended_at)
        assert len(robot.journal) == 0
        assert one.worker == "", "the server's own goal is as it was"


async def test_writes_of_a_goal_follow_each_other_without_a_wait() -> None:
    async with MemoryBrokers() as shared, member(shared) as robot:
        one = goal(is_running=False, attempt=0)
        robot.write("accept", one)
        one.is_running, one.attempt = True, 1
        robot.write("begin", one)
        one.checkpoint = b"half"
        robot.write("checkpoint", one)
        one.status = GoalStatus.CANCELING
        robot.write("cancel", one)
        robot.write("end", ended(one))
        await robot.answered(5)
        assert robot.errors == [None] * 5
        kept = [goal_entry(write.data).goal for write in writes(shared)]
        assert [one.attempt for one in kept] == [0, 1, 1, 1, 1]
        assert [one.checkpoint for one in kept] == [None, None, *[b"half"] * 3]
        assert [one.status for one in kept][-2:] == [GoalStatus.CANCELING, GoalStatus.SUCCEEDED]


async def test_a_goal_of_another_worker_is_taken() -> None:
    async with MemoryBrokers() as shared, member(shared, "a") as a, member(shared, "b") as b:
        one = goal()
        a.write("accept", one)
        await a.answered(1)
        b.write("accept", one)
        b.write("end", ended(one))
        await b.answered(2)
        assert b.errors == [GoalTaken, GoalTaken]
        assert len(b.journal) == 0
        found = entry(shared, one)
        assert found.goal.worker == "a"
        b.write("begin", one)  # of a goal that it does not have
        assert b.errors == [GoalTaken] * 3


async def test_an_outcome_that_the_server_has_forgotten_is_replaced() -> None:
    async with MemoryBrokers() as shared, member(shared) as robot:
        one = goal()
        robot.write("accept", one)
        robot.write("end", ended(one))
        await robot.answered(2)
        robot.write("accept", one)
        await robot.answered(3)
        assert robot.errors == [None] * 3
        found = entry(shared, one)
        assert found.goal.status is GoalStatus.ACCEPTED


async def test_nothing_is_written_over_a_marker_or_rubbish_in_place_of_a_goal() -> None:
    async with MemoryBrokers() as shared, member(shared) as robot:
        for number, data in ((1, b""), (2, b"rubbish")):
            one = goal(number)
            robot.write("accept", one)
            await robot.answered(2 * number - 1)
            shared.store(NAMES.goal("count", one.goal_id), data, 60)
            robot.write("end", ended(one))
            await robot.answered(2 * number)
        assert robot.errors == [None, GoalTaken] * 2


# Doubt


async def test_an_old_answer_of_a_broker_that_is_behind_takes_no_goal_away() -> None:
    async with MemoryBrokers() as shared, member(shared) as robot:
        one = goal()
        robot.write("accept", one)
        await robot.answered(1)
        name = NAMES.goal("count", one.goal_id)
        robot.write("checkpoint", one)
        await robot.answered(2)
        old = [None, BrokerRecord(name, b"old", 1)]
        robot.broker.old = {name: old}
        shared.loses_answer = lambda write: write.subject == name
        robot.write("end", ended(one))
        await robot.answered(3)
        assert robot.errors == [None] * 3
        assert not old
        assert len(writes(shared)) == 3


async def test_the_next_worker_s_write_is_told_from_a_lost_answer() -> None:
    async with MemoryBrokers() as shared, member(shared) as robot:
        one = goal()
        robot.write("accept", one)
        await robot.answered(1)
        robot.broker.is_away = True
        robot.write("end", ended(one))
        await sleep(0.1)
        other = encode(GoalEntry(one, b"other", b"9999"))
        shared.store(NAMES.goal("count", one.goal_id), other, 100)
        robot.broker.is_away = False
        await robot.answered(2)
        assert robot.errors == [None, GoalTaken]


async def test_all_goals_are_lost_when_the_lease_ends() -> None:
    async with MemoryBrokers() as shared, member(shared) as robot:
        one, two = goal(1), goal(2)
        robot.write("accept", one)
        await robot.answered(1)
        robot.broker.is_away = True
        robot.write("accept", two)
        await sleep(LEASE)
        assert set(robot.lost) == {one.goal_id, two.goal_id}
        assert robot.errors == [None, GoalTaken]
        assert len(robot.journal) == 0
        robot.write("end", ended(one))
        robot.write("accept", goal(3))
        assert robot.errors[2:] == [GoalTaken, GoalTaken]
        robot.broker.is_away = False
        await sleep(LEASE)
        assert not is_kept(shared, two), "nothing of the old incarnation was written"
        robot.write("accept", goal(4))
        await robot.answered(5)
        found = entry(shared, goal(4))
        assert found.incarnation == robot.membership.incarnation


async def test_a_frozen_worker_writes_nothing() -> None:
    async with MemoryBrokers() as shared, member(shared, is_frozen=True) as robot:
        robot.write("accept", goal())
        await robot.answered(1)
        await sleep(LEASE)  # none of its tasks ran
        robot.write("end", ended(goal()))
        assert robot.errors == [None, GoalTaken]
        assert robot.lost == [goal().goal_id]
        found = entry(shared, goal())
        assert found.goal.status.is_active


# Sizes


async def test_what_is_too_large_concerns_its_goal_alone() -> None:
    async with MemoryBrokers() as shared, member(shared) as robot:
        large = bytes(2**20)
        robot.write("accept", goal(1, goal=large))
        robot.write("accept", goal(2))
        robot.write("checkpoint", goal(2, checkpoint=large))
        robot.write("end", replace(ended(goal(2)), result=large))
        robot.write("end", ended(goal(2)))
        await robot.answered(5)
        assert robot.errors == [RecordTooLarge, None, RecordTooLarge, RecordTooLarge, None]
        assert "and the brokers take 1048576 at most" in str(robot.answers[0][1])
        assert len(robot.journal) == 0


async def test_a_full_stream_takes_no_new_goals_and_all_of_the_others_when_there_is_room() -> None:
    async with MemoryBrokers() as shared, member(shared) as robot:
        robot.write("accept", goal(1))
        robot.write("accept", goal(2))
        await robot.answered(2)
        shared.goals_are_full = True
        robot.write("accept", goal(3))
        await robot.answered(3)
        assert isinstance(robot.answers[2][1], StoreFull)
        assert "of fleet 'test' keep no more goals: maximum bytes" in str(robot.answers[2][1])
        robot.write("begin", goal(1))
        robot.write("end", ended(goal(2)))
        await sleep(5)
        shared.goals_are_full = False
        robot.write("accept", goal(3))  # the room is for those that wait
        await robot.answered(6)
        assert robot.errors == [None, None, StoreFull, None, None, StoreFull]
        assert "accepted goals wait for room" in str(robot.answers[5][1])
        robot.write("accept", goal(3))
        robot.write("end", ended(goal(1)))
        await robot.answered(8)
        assert robot.errors[6:] == [None, None]


async def test_a_worker_stops_though_the_stream_is_full() -> None:
    async with MemoryBrokers() as shared:
        async with member(shared) as robot:
            robot.write("accept", goal(1))
            robot.write("accept", goal(2))
            await robot.answered(2)
            shared.goals_are_full = True
            robot.write("end", ended(goal(1)))
            await sleep(3)
        assert robot.errors == [None, None, StoreError]
        assert robot.journals.has_goals_left


async def test_what_waits_for_room_is_not_written_once_another_worker_has_the_goal() -> None:
    async with MemoryBrokers() as shared, member(shared) as robot:
        robot.write("accept", goal(1))
        await robot.answered(1)
        shared.goals_are_full = True
        robot.write("end", ended(goal(1)))
        await sleep(2)
        robot.journal.lose(goal(1).goal_id)
        await robot.answered(2)
        assert robot.errors == [None, GoalTaken]
        shared.goals_are_full = False
        robot.write("accept", goal(2))
        await robot.answered(3)
        assert robot.errors[2] is None


@pytest.mark.parametrize(
    ("earlier", "later"),
    [("accept", "take"), ("accept", "begin"), ("take", "begin"), ("begin", "cancel")],
)
async def test_a_record_is_smaller_than_the_one_before_so_that_a_full_stream_takes_it(
    earlier: str, later: str
) -> None:
    def size(kind: str) -> int:
        write = record_writes.Write(kind, goal(1), "robot", b"incarnat", lambda _error: None)
        return len(write.data)

    assert size(later) < size(earlier) - 50
    assert size("end") < size("cancel") - 300


# Outcomes


async def test_an_outcome_ends_by_its_time_to_live() -> None:
    async with MemoryBrokers() as shared, member(shared) as robot:
        one = goal()
        robot.write("accept", one)
        robot.write("end", ended(one, time.time_ns() + 4_500_000_000))
        await robot.answered(2)
        await sleep(4)
        assert is_kept(shared, one)
        await sleep(1.1)
        assert not is_kept(shared, one)


async def test_the_oldest_outcomes_beyond_the_limit_are_deleted() -> None:
    async with MemoryBrokers() as shared, member(shared, max_results=2) as robot:
        for number in range(4):
            robot.write("accept", goal(number))
            robot.write("end", ended(goal(number)))
        await robot.answered(8)
        await robot.broker.flush()
        kept = [number for number in range(4) if is_kept(shared, goal(number))]
        assert kept == [2, 3]


# Takeover


async def test_a_taken_goal_is_claimed_with_its_former_worker() -> None:
    async with MemoryBrokers() as shared, member(shared, "a") as a, member(shared, "b") as b:
        one = goal(is_running=False, attempt=0)
        a.write("accept", one)
        await a.answered(1)
        record = shared.record_of(NAMES.goal("count", one.goal_id))
        assert await b.journal.take(record, goal_entry(record.data).goal)
        assert b.claimed == [replace(one, worker="a")]
        assert b.journal.has(one.goal_id)
        found = entry(shared, one)
        assert (found.goal.worker, found.incarnation) == ("b", b.membership.incarnation)
        assert not await b.journal.take(record, one), "it has it already"
        a.write("begin", one)
        await a.answered(2)
        assert a.errors == [None, GoalTaken]
        b.write("begin", b.claimed[0])
        await b.answered(1)
        assert b.errors == [None]


async def test_a_goal_that_is_being_taken_is_not_accepted_anew() -> None:
    async with MemoryBrokers() as shared, member(shared) as robot:
        one = goal()
        shared.put(NAMES.goal("count", one.goal_id), encode(GoalEntry(one, b"", b"1234")), 0, 100)
        record = shared.record_of(NAMES.goal("count", one.goal_id))
        shared.delay = lambda: 0.5
        async with create_task_group() as tasks:
            tasks.start_soon(robot.journal.take, record, replace(one))
            await sleep(0.1)
            robot.write("accept", one)
        assert robot.errors == [GoalTaken]
        assert robot.claimed == [one]


# The store


async def test_an_action_is_served_once() -> None:
    async with MemoryBrokers() as shared, member(shared) as robot:
        with pytest.raises(StoreError, match="this worker serves the action 'count' already"):
            async with robot.store.open(
                "count", max_results=9, claim=robot.claim, lose=robot.lost.append
            ):
                pass


# Goals that are lost in the middle of a write


async def test_a_write_within_an_answer_is_answered_after_it() -> None:
    async with MemoryBrokers() as shared, member(shared) as robot:

        def then(error: StoreError | None) -> None:
            robot.write("end", ended(goal(9)), "within")  # of a goal that it does not have
            robot.then("first")(error)

        robot.journal.accept(goal(), then)
        await robot.answered(2)
        assert [name for name, _ in robot.answers] == ["first", "within"]
        assert robot.errors == [None, GoalTaken]


async def test_a_frozen_worker_clears_no_doubt() -> None:
    async with MemoryBrokers() as shared, member(shared, is_frozen=True) as robot:
        shared.loses_answer = lambda write: ".goal." in write.subject
        await sleep(LEASE / 2)
        robot.write("accept", goal())
        await robot.answered(1)
        assert robot.errors == [GoalTaken]
        assert robot.lost == [goal().goal_id]
        assert len(writes(shared)) == 1


@pytest.mark.parametrize("when", ["while its record is read", "before it is written again"])
async def test_a_goal_in_doubt_can_be_lost(when: str) -> None:
    async with MemoryBrokers() as shared, member(shared) as robot:

        async def lose_soon() -> None:
            await sleep(FIRST_PAUSE / 2)
            robot.journal.lose(goal().goal_id)

        async def lose(call: str, subject: str) -> None:
            if call != "get" or ".goal." not in subject:
                return
            if when == "before it is written again":
                robot.journals.tasks.start_soon(lose_soon)
                robot.broker.old = {subject: [None]}
            else:
                robot.journal.lose(goal().goal_id)

        robot.broker.before = lose
        shared.loses_answer = lambda write: ".goal." in write.subject
        robot.write("accept", goal())
        await robot.answered(1)
        await sleep(1)
        assert robot.errors == [GoalTaken]
        assert robot.lost == [goal().goal_id]
        assert len(writes(shared)) == 1


# A lost stream


async def test_the_records_of_goals_are_written_again_when_their_stream_was_lost() -> None:
    async with MemoryBrokers() as shared, member(shared) as robot:
        robot.write("accept", goal(1))
        robot.write("accept", goal(2))
        robot.write("accept", goal(3))
        robot.write("end", ended(goal(3)))
        await robot.answered(4)
        shared.lose_streams()
        robot.write("cancel", goal(2, status=GoalStatus.CANCELING))
        robot.journal.rewrite_all()
        await robot.answered(5)
        await sleep(1)
        kept = [entry(shared, goal(number)).goal.status for number in (1, 2)]
        assert kept == [GoalStatus.ACCEPTED, GoalStatus.CANCELING]
        assert not is_kept(shared, goal(3))
        robot.write("end", ended(goal(1)))
        robot.write("end", ended(goal(2)))
        await robot.answered(7)
        assert robot.errors == [None] * 7


# How an action of a fleet takes goals, kept by the brokers for all workers


async def add(one: Member, text: bytes) -> bytes:
    return await one.journal.change_intake(lambda kept: kept if text in kept else kept + text)


async def test_all_workers_have_what_one_has_kept_and_no_change_is_lost() -> None:
    async with MemoryBrokers() as shared, member(shared, "a") as a, member(shared, "b") as b:
        assert await b.journal.intake() == b""
        assert await add(a, b"1") == b"1"
        assert await b.journal.intake() == b"1"
        async with anyio.create_task_group() as tasks:
            for one, text in ((a, b"2"), (b, b"3"), (a, b"4")):
                tasks.start_soon(add, one, text)
        kept = await a.journal.intake()
        assert sorted(kept) == sorted(b"1234")
        assert kept == await b.journal.intake()
        assert await add(b, b"4") == kept


async def test_what_was_lost_with_its_stream_is_kept_again() -> None:
    async with MemoryBrokers() as shared, member(shared, "a") as a, member(shared, "b") as b:
        await add(a, b"1")
        shared.lose_streams()
        assert await b.journal.intake() == b""
        assert await a.journal.intake() == b"1"
        assert await b.journal.intake() == b"1"


async def test_brokers_that_agree_on_their_leader_are_waited_for() -> None:
    async with (
        MemoryBrokers() as shared,
        member(shared, "a") as a,
        anyio.create_task_group() as tasks,
    ):

        async def agree() -> None:
            await anyio.sleep(10)
            a.broker.is_away = False

        await add(a, b"1")
        a.broker.is_away = True
        tasks.start_soon(agree)
        assert await a.journal.intake() == b"1"


async def test_a_lost_answer_is_looked_up() -> None:
    async with MemoryBrokers() as shared, member(shared, "a") as a:

        def loses(write: Write) -> bool:
            return write.subject == NAMES.intake("count") and len(shared.writes) % 2 == 1

        shared.loses_answer = loses
        assert await add(a, b"1") == b"1"
        assert await a.journal.intake() == b"1"


async def test_a_change_that_cannot_be_kept_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal, "INTAKE_TRIES", 3)
    async with MemoryBrokers() as shared, member(shared, "a") as a:
        number = iter(range(99))

        def other_is_faster(_kept: bytes) -> bytes:
            newest = shared.newest(NAMES.intake("count"))
            shared.store(NAMES.intake("count"), b"%d" % next(number), 99)
            return b"mine" if newest is None else newest.data + b"mine"

        with pytest.raises(StoreError, match="too many others change it"):
            await a.journal.change_intake(other_is_faster)
        shared.is_full = True
        with pytest.raises(StoreError, match="maximum bytes"):
            await add(a, b"1")
        a.broker.is_away = True
        for call in (a.journal.intake(), add(a, b"2")):
            with pytest.raises(StoreError, match="the intake cannot be"):
                await call


async def test_a_stream_that_cannot_be_made_is_an_error_of_the_store(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def fail(*_: object, **__: object) -> None:
        raise TransportError("it is of something else")

    async with MemoryBrokers() as shared, member(shared, "a") as a:
        monkeypatch.setattr(a.broker, "create_streams", fail)
        with pytest.raises(StoreError, match="of something else"):
            await add(a, b"1")

"""The history of a fleet: goals that are added to it, and pages that are read, in memory."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest

from fibaction import GoalID, GoalInfo, GoalStatus, StoreError
from fibaction.border.event_loop import Background
from fibaction.border.goal_store import StoredGoal
from fibaction.words.goal_query import GoalQuery, PastPage
from fibaction_transports.nats.broker.broker import BrokerWatch
from fibaction_transports.nats.history import fleet_history, history_writes
from fibaction_transports.nats.history.fleet_history import HISTORY_TIMEOUT, FleetHistory
from fibaction_transports.nats.history.history_writes import HistoryWrites
from tests.support.memory_broker import ANSWER_TIMEOUT, MemoryBroker, MemoryBrokers, Write
from tests.support.virtual_time import in_virtual_time
from tests.transports.hearing import Hearing
from tests.transports.nats.members import LEASE, NAMES, Member, entry, goal, keep, member

pytestmark = [pytest.mark.anyio, in_virtual_time()]


def ended(number: int = 1, **fields: Any) -> StoredGoal:
    """Return a goal that has ended as the number-th one, as its record has it."""
    changes: dict[str, Any] = {"status": GoalStatus.SUCCEEDED, "is_running": False, "goal": b""}
    changes |= {"ended_at": number, "result": b"result", "worker": "a", "meta": None, **fields}
    return goal(number, **changes)


async def noted(broker: MemoryBroker, *numbers: int, **fields: Any) -> FleetHistory:
    """Return a history with these goals."""
    async with Background() as tasks:
        writes = HistoryWrites(broker, NAMES)
        writes.open(tasks, LEASE)
        for number in numbers:
            writes.add("count", ended(number, **fields), goal(number, meta={"order": str(number)}))
        await writes.settle()
    return FleetHistory(broker, NAMES, "count")


def stamps(goals: list[Any]) -> list[int]:
    return [one.stamp for one in goals]


# What a server does


async def run_one(worker: Member, number: int = 1, **fields: Any) -> None:
    """Let a goal begin and end at a member."""
    done = anyio.Event()
    one = goal(number, meta={"order": str(number), "traceparent": "00-1"})
    worker.accept(one)
    await worker.broker.flush()
    one.drop_request()
    one.status, one.result, one.ended_at = GoalStatus.SUCCEEDED, b"result", number
    one.is_running, one.keep_until = False, fields.get("keep_until", 0)
    worker.journal.end(one, lambda _error: done.set())
    await done.wait()


async def test_without_a_history_nothing_is_added() -> None:
    async with MemoryBrokers() as shared, member(shared, "a") as a:
        await run_one(a)
        keep(shared, ended(2))
        a.broker.begin_anew()
        assert await a.journal.past_goals(PastPage()) == []
        assert not shared.heads


async def test_the_record_of_an_end_stays_until_others_could_have_found_it() -> None:
    async with MemoryBrokers() as shared, member(shared, "a") as a:
        a.journals.history.open(a.journals.tasks, lease=100)
        await run_one(a, keep_until=1)
        await anyio.sleep(150)
        assert entry(shared, goal()).goal.status is GoalStatus.SUCCEEDED


async def test_the_end_of_a_worker_waits_for_its_goals_to_be_added() -> None:
    async with MemoryBrokers() as shared:
        async with member(shared, "a") as a:
            a.journals.history.open(a.journals.tasks, LEASE)
            await run_one(a)
        assert list(shared.heads) == [NAMES.past("count", goal().goal_id, 1)]


@pytest.mark.promise("FLEET-13")
async def test_what_a_lost_worker_has_not_added_is_added_by_another_one() -> None:
    async with MemoryBrokers() as shared:
        keep(shared, ended(1, worker="gone"), b"gone")
        keep(shared, ended(2, worker="other"), b"gone")
        keep(shared, goal(3), b"gone")
        async with member(shared, "a") as a:
            a.journals.history.open(a.journals.tasks, LEASE)
            past: list[int] = []
            with anyio.fail_after(30 * LEASE):
                while len(past) < 2:
                    await anyio.sleep(1)
                    past = stamps(await a.journal.past_goals(PastPage()))
            assert past == [2, 1]


async def test_records_of_lost_workers_are_looked_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(history_writes, "MOST_SEEN", 1)
    async with MemoryBrokers() as shared, member(shared, "a") as a:
        for number in (1, 2):
            keep(shared, ended(number), b"gone")
        keep(shared, ended(3), a.membership.incarnation)
        a.journals.history.open(a.journals.tasks, LEASE)
        asked: list[str] = []
        put = a.broker.put

        def putting(subject: str, data: bytes, **given: Any) -> None:
            asked.append(subject)
            put(subject, data, **given)

        monkeypatch.setattr(a.broker, "put", putting)
        takeover: Any = a.takeover
        is_gone = takeover._lost.is_gone
        for _ in range(2):
            for number in (2, 2, 1, 3):
                record = shared.newest(NAMES.goal("count", goal(number).goal_id))
                assert record is not None
                await a.journals.history.add_left(record, entry(shared, goal(number)), is_gone)
                await a.journals.history.settle()
    first, second = (NAMES.past("count", goal(one).goal_id, one) for one in (1, 2))
    assert asked == [second, first] * 2


# Writes that fail


@pytest.mark.promise("FLEET-13")
async def test_a_write_without_an_answer_is_made_again_and_the_goal_is_there_once() -> None:
    async with MemoryBrokers() as shared:
        broker = shared.member()
        lost: list[Write] = []

        def loses(write: Write) -> bool:
            lost.append(write)
            return len(lost) == 1

        shared.loses_answer = loses
        async with Background() as tasks:
            writes = HistoryWrites(broker, NAMES)
            writes.open(tasks, LEASE)
            writes.add("count", ended(), goal())
            writes.add("count", ended(), goal())
            await writes.settle()
            begun = anyio.current_time()
            await writes.settle()
            assert anyio.current_time() == begun
        assert len(lost) == 1  # the second time it was refused
        assert stamps(await FleetHistory(broker, NAMES, "count").past_goals(PastPage())) == [1]


async def test_brokers_that_are_away_are_waited_for_and_not_at_the_end() -> None:
    async with MemoryBrokers() as shared:
        broker = shared.member()
        async with Background() as tasks:
            writes = HistoryWrites(broker, NAMES)
            writes.open(tasks, LEASE)
            broker.is_away = True
            writes.add("count", ended(), goal())
            begun = anyio.current_time()
            await writes.settle()
            assert anyio.current_time() == begun + history_writes.LAST_WRITES
            broker.is_away = False
            await anyio.sleep(2 * ANSWER_TIMEOUT)
        assert len(shared.heads) == len(shared.records) == 1


async def test_goals_for_which_there_is_no_room_are_left_out_with_one_line(log: Hearing) -> None:
    async with MemoryBrokers() as shared:
        broker = shared.member()
        shared.is_full = True
        assert stamps(await (await noted(broker, 1, 2)).past_goals(PastPage())) == []
        shared.is_full = False
        assert stamps(await (await noted(broker, 3)).past_goals(PastPage())) == [3]
    [line] = log.warnings
    assert line == (
        "goals that end now may be missing in the history of fleet 'test': maximum bytes exceeded"
        " (stream FIB_test_HISTORY)"
    )


async def test_goals_that_end_while_too_much_waits_are_left_out(
    log: Hearing, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history_writes, "MOST_WAITING", 1)
    async with MemoryBrokers() as shared:
        past = await noted(shared.member(), 1, 2, 3)
        assert stamps(await past.past_goals(PastPage())) == [1]
    assert len(log.warnings) == 1
    assert "too many goals wait to be added" in log.warnings[0]


@pytest.mark.parametrize(("size", "kept"), [(400_000, b"result"), (2**20, None)])
async def test_what_is_too_large_is_left_out_of_a_goal(size: int, kept: bytes | None) -> None:
    async with MemoryBrokers() as shared:
        broker = shared.member()
        async with Background() as tasks:
            writes = HistoryWrites(broker, NAMES)
            writes.open(tasks, LEASE)
            result = b"result" if kept else bytes(size)
            writes.add("count", ended(result=result), goal(goal=bytes(2**20)))
            await writes.settle()
        past = await FleetHistory(broker, NAMES, "count").past_goal(goal().goal_id)
    assert past is not None
    assert (past.goal, past.result) == (b"", kept)


# Pages


async def test_pages_are_in_the_order_of_acceptance_whatever_the_order_of_the_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(fleet_history, "HELD", 1)
    async with MemoryBrokers() as shared:
        broker = shared.member()
        past = await noted(broker, 3, 1, 5, 2, 4)
        first = await past.past_goals(PastPage(limit=2))
        place = (first[-1].stamp, bytes(first[-1].goal_id))
        rest = await past.past_goals(PastPage(limit=9, after=place))
        oldest = await past.past_goals(PastPage(limit=2, newest_first=False))
        since = await past.past_goals(PastPage(GoalQuery(since=4)))
        labeled = await past.past_goals(PastPage(GoalQuery(labels=(("order", "3"),))))
    assert (stamps(first), stamps(rest)) == ([5, 4], [3, 2, 1])
    assert (stamps(oldest), stamps(since), stamps(labeled)) == ([1, 2], [5, 4], [3])


async def test_a_page_has_each_goal_once_though_the_watch_begins_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with MemoryBrokers() as shared:
        broker = shared.member()
        past = await noted(broker, 1, 2)
        watch_once = broker.watch

        @asynccontextmanager
        async def twice(
            stream: str, subject: str, **given: Any
        ) -> AsyncGenerator[BrokerWatch, None]:
            async with watch_once(stream, subject, **given) as watch:
                watch._found.appendleft(shared.matching(subject)[:1])
                yield watch

        monkeypatch.setattr(broker, "watch", twice)
        assert stamps(await past.past_goals(PastPage())) == [2, 1]
        read: list[GoalInfo] = []
        await past.read_past(GoalQuery(), read.extend)
        assert sorted(info.stamp for info in read) == [1, 2]


async def test_of_a_goal_that_ran_twice_the_newest_run_is_found() -> None:
    async with MemoryBrokers() as shared:
        broker = shared.member()
        goal_id = GoalID(bytes(range(16)))
        past = await noted(broker, 5, 7, 6, goal_id=goal_id)
        found = await past.past_goal(goal_id)
        assert found is not None
        assert found.stamp == 7
        assert stamps(await past.past_goals(PastPage())) == [7, 6, 5]


async def test_a_record_that_cannot_be_read_is_left_out() -> None:
    async with MemoryBrokers() as shared:
        broker = shared.member()
        past = await noted(broker, 1)
        subject = NAMES.past("count", goal(2).goal_id, 2)
        head = b"of a later version"
        broker.put(subject, b"as well", expected=0, head=head, then=lambda _answer: None)
        await broker.flush()
        assert stamps(await past.past_goals(PastPage())) == [1]
        assert await past.past_goal(goal(2).goal_id) is None


async def test_brokers_that_do_not_answer_are_an_error() -> None:
    async with MemoryBrokers() as shared:
        broker = shared.member()
        past = FleetHistory(broker, NAMES, "count")
        broker.is_away = True
        with pytest.raises(StoreError, match="the history of the fleet cannot be read"):
            await past.past_goals(PastPage())
        with pytest.raises(StoreError, match="the history of the fleet cannot be read"):
            await past.past_goal(goal().goal_id)


async def test_brokers_that_stop_to_tell_the_history_are_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with MemoryBrokers() as shared:
        broker = shared.member()
        past = await noted(broker, 1)
        watch_once = broker.watch

        @asynccontextmanager
        async def stopping(
            stream: str, subject: str, **given: Any
        ) -> AsyncGenerator[BrokerWatch, None]:
            async with watch_once(stream, subject, **given) as watch:
                broker.is_away = True
                yield watch

        monkeypatch.setattr(broker, "watch", stopping)
        with pytest.raises(StoreError, match=f"no answer within {HISTORY_TIMEOUT:g} s"):
            await past.past_goals(PastPage())

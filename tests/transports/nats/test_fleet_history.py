"""The history of a fleet: goals that are added, pages that are read, and goals it gave up."""

from __future__ import annotations

import time
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from functools import partial
from typing import Any

import anyio
import pytest
from anyio import sleep

from fibaction import ConnectionLost, GoalID, GoalInfo, GoalStatus, ServerNotFound, StoreError
from fibaction.border.abc import Endpoint, ForwardingEndpoint
from fibaction.border.event_loop import Background
from fibaction.border.goal_store import StoredGoal
from fibaction.words.goal_query import GoalQuery, PastPage
from fibaction.words.goals import UNKNOWN_SENDER, digest_of
from fibaction_transports.nats import fleet_history
from fibaction_transports.nats.broker.broker import BrokerWatch
from fibaction_transports.nats.fleet_history import (
    HISTORY_TIMEOUT,
    FleetHistory,
    HistoryWrites,
    given_up_goals,
    rerun_goal,
)
from fibaction_transports.nats.records import SECOND, encode
from tests.support.memory_broker import (
    ANSWER_TIMEOUT,
    MemoryBroker,
    MemoryBrokers,
    MemoryWatch,
    Write,
)
from tests.support.virtual_time import in_virtual_time
from tests.transports.hearing import Hearing
from tests.transports.nats.fake_fleet import (
    COUNT,
    ENDED,
    GOAL_ID,
    THREE,
    FakeFleet,
    FakeWorker,
    client_of,
    server,
)
from tests.transports.nats.members import LEASE, NAMES, Member, entry, goal, keep, member

pytestmark = [pytest.mark.anyio, in_virtual_time()]


def ended(number: int = 1, **fields: Any) -> StoredGoal:
    """Return a goal that has ended as the number-th one, as its record has it."""
    changes: dict[str, Any] = {"status": GoalStatus.SUCCEEDED, "is_running": False, "goal": b""}
    changes |= {"ended_at": number, "result": b"result", "worker": "a", "meta": None, **fields}
    return goal(number, **changes)


@asynccontextmanager
async def adding(broker: MemoryBroker) -> AsyncGenerator[HistoryWrites, None]:
    async with Background() as tasks:
        writes = HistoryWrites(broker, NAMES)
        writes.open(tasks, LEASE)
        yield writes


async def noted(broker: MemoryBroker, *numbers: int, **fields: Any) -> FleetHistory:
    """Return a history with these goals."""
    async with adding(broker) as writes:
        for number in numbers:
            writes.add("count", ended(number, **fields), goal(number, meta={"order": str(number)}))
        await writes.settle()
    return FleetHistory(broker, NAMES, "count")


def change_watches(
    monkeypatch: pytest.MonkeyPatch, broker: MemoryBroker, change: Callable[[MemoryWatch], None]
) -> None:
    """Let something happen to each watch when it has begun."""
    watch_once = broker.watch

    @asynccontextmanager
    async def changed(*args: Any, **given: Any) -> AsyncGenerator[BrokerWatch, None]:
        async with watch_once(*args, **given) as watch:
            change(watch)
            yield watch

    monkeypatch.setattr(broker, "watch", changed)


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
    monkeypatch.setattr(fleet_history, "MOST_SEEN", 1)
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
                record = shared.record_of(NAMES.goal("count", goal(number).goal_id))
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
        async with adding(broker) as writes:
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
        async with adding(broker) as writes:
            broker.is_away = True
            writes.add("count", ended(), goal())
            begun = anyio.current_time()
            await writes.settle()
            assert anyio.current_time() == begun + fleet_history.LAST_WRITES
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
    monkeypatch.setattr(fleet_history, "MOST_WAITING", 1)
    async with MemoryBrokers() as shared:
        past = await noted(shared.member(), 1, 2, 3)
        assert stamps(await past.past_goals(PastPage())) == [1]
    assert len(log.warnings) == 1
    assert "too many goals wait to be added" in log.warnings[0]


@pytest.mark.parametrize(("size", "kept"), [(400_000, b"result"), (2**20, None)])
async def test_what_is_too_large_is_left_out_of_a_goal(size: int, kept: bytes | None) -> None:
    async with MemoryBrokers() as shared:
        broker = shared.member()
        async with adding(broker) as writes:
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
        change_watches(
            monkeypatch,
            broker,
            lambda watch: watch._found.appendleft(shared.matching(watch.subject)[:1]),
        )
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
        change_watches(monkeypatch, broker, lambda _watch: setattr(broker, "is_away", True))
        with pytest.raises(StoreError, match=f"no answer within {HISTORY_TIMEOUT:g} s"):
            await past.past_goals(PastPage())


# The goals of a fleet that were given up


def given_up(number: int = 1, **fields: object) -> StoredGoal:
    """Return a goal that was given up as the number-th one."""
    changes: dict[str, object] = {"status": GoalStatus.ABORTED, "is_running": False}
    changes |= {"ended_at": number, "reason": "given up", "checkpoint": b"half", **fields}
    return goal(number, **changes)


async def test_they_are_listed_in_the_order_of_their_ends() -> None:
    async with MemoryBrokers() as shared:
        for number in (3, 1, 2):
            keep(shared, given_up(number))
        keep(shared, goal(4))
        keep(shared, given_up(5, goal=b""))
        shared.put(NAMES.goal("count", goal(6).goal_id), b"", 0, 60)
        found = await given_up_goals(shared.member(), NAMES)
        assert found == {"count": [given_up(1), given_up(2), given_up(3)]}


async def test_one_runs_again_once_as_a_new_goal_from_its_checkpoint() -> None:
    async with MemoryBrokers() as shared, member(shared, "a") as a:
        until = time.time_ns() + 100 * SECOND
        keep(shared, given_up(keep_until=until))
        rerun = partial(rerun_goal, shared.member(), NAMES)
        new = await rerun("count", given_up().goal_id)
        (claimed,) = await a.claims(1, within=1)
        assert claimed.goal_id == new != given_up().goal_id
        assert (claimed.goal, claimed.checkpoint) == (b"goal", b"half")
        assert (claimed.attempt, claimed.is_running) == (0, False)
        old = entry(shared, given_up()).goal
        assert (old.status, old.reason, old.keep_until) == (GoalStatus.ABORTED, "given up", until)
        assert not old.is_given_up
        with pytest.raises(StoreError, match="was not given up, or is not kept any more"):
            await rerun("count", given_up().goal_id)


async def test_what_was_not_given_up_does_not_run_again() -> None:
    async with MemoryBrokers() as shared:
        rerun = partial(rerun_goal, shared.member(), NAMES)
        with pytest.raises(StoreError, match="was not given up, or is not kept any more"):
            await rerun("count", goal().goal_id)
        keep(shared, given_up())
        keep(shared, given_up().as_new(1))
        with pytest.raises(StoreError, match="runs again already, as goal "):
            await rerun("count", given_up().goal_id)
        shared.is_full = True
        keep_again = given_up(2)
        shared.is_full = False
        keep(shared, keep_again)
        shared.is_full = True
        with pytest.raises(StoreError, match="cannot be run again: "):
            await rerun("count", keep_again.goal_id)


async def test_brokers_that_are_away_are_an_error() -> None:
    async with MemoryBrokers() as shared:
        broker = shared.member()
        broker.is_away = True
        rerun = partial(rerun_goal, broker, NAMES)
        with pytest.raises(ConnectionLost, match="the goals of the fleet cannot be listed: "):
            await given_up_goals(broker, NAMES)
        with pytest.raises(StoreError, match="cannot be read"):
            await FleetHistory(broker, NAMES, "count").rerun(goal().goal_id)
        with pytest.raises(ConnectionLost, match="the record of goal 0101"):
            await rerun("count", given_up().goal_id)


async def test_a_fleet_keeps_so_many_of_them_also_over_restarts_of_its_workers() -> None:
    async with MemoryBrokers() as shared:
        for number in range(1, 12):
            keep(shared, given_up(number))
        async with member(shared, "a") as a:  # it keeps nine
            await sleep(1)
            kept = [one.stamp for one in (await given_up_goals(a.broker, NAMES))["count"]]
            assert kept == list(range(3, 12))
            a.accept(goal(20), goal(21))
            a.journal.end(given_up(20), lambda _error: None)
            a.journal.end(given_up(21, goal=b""), lambda _error: None)
            await sleep(LEASE)
            kept = [one.stamp for one in (await given_up_goals(a.broker, NAMES))["count"]]
            assert kept == [*range(4, 12), 20]


async def test_one_is_read_with_its_checkpoint_as_long_as_it_can_run_again() -> None:
    async with MemoryBrokers() as shared, member(shared, "a"):
        keep(shared, given_up())
        keep(shared, goal(2))
        history = FleetHistory(shared.member(), NAMES, "count")
        found = await history.given_up(given_up().goal_id)
        assert found is not None
        assert found.checkpoint == b"half"
        for number in (2, 3):
            assert await history.given_up(goal(number).goal_id) is None
        assert await history.rerun(given_up().goal_id) is not None
        assert await history.rerun(given_up().goal_id) is None
        assert await history.given_up(given_up().goal_id) is None
        shared.put(NAMES.goal("count", goal(6).goal_id), b"of a later version", 0, 60)
        with pytest.raises(StoreError, match="cannot be read"):
            await history.given_up(goal(6).goal_id)


# The history of a fleet as its clients read it: pages, goals, and the histories of gateways


@pytest.fixture
def fleet() -> FakeFleet:
    return FakeFleet()


def past(number: int = 7, goal_id: GoalID = GOAL_ID) -> StoredGoal:
    """Return a goal of the past that was accepted as the number-th one."""
    fields = ENDED | {"goal": THREE, "began_at": number, "meta": {"order": "17"}, "worker": "gone"}
    return StoredGoal(goal_id, number, UNKNOWN_SENDER, digest_of(THREE), attempt=1, **fields)


def note(fleet: FakeFleet, *goals: StoredGoal) -> None:
    for one in goals:
        fleet.broker.store(NAMES.past("count", one.goal_id, one.stamp), encode(one))


def numbered(number: int) -> StoredGoal:
    return past(number, GoalID(bytes([number]) * 16))


async def test_a_goal_of_the_past_is_followed_as_if_it_were_remembered(fleet: FakeFleet) -> None:
    note(fleet, past())
    async with fleet.connect() as connection:
        stream = await connection.endpoint(COUNT).feedback(GOAL_ID)
        assert (stream.goal, stream.info) == (THREE, past().info)
        assert (await stream.outcome()).result == COUNT.result.encode("3")
        with pytest.raises(ServerNotFound):
            await connection.endpoint(COUNT).feedback(GoalID(bytes([9]) * 16))


async def test_a_goal_that_its_owner_has_forgotten_is_found_in_the_history(
    fleet: FakeFleet,
) -> None:
    note(fleet, past())
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        a.own(GOAL_ID, **ENDED)
        stream = await connection.endpoint(COUNT).feedback(GOAL_ID)
        assert stream.info.labels == {"order": "17"}


async def test_a_goal_that_has_ended_at_a_worker_is_told_as_its_record_says(
    fleet: FakeFleet,
) -> None:
    async with fleet.worker("a").serve(server()), fleet.connect() as connection:
        client = client_of(connection)
        goal = await client.send_goal(3, labels={"order": "17"})
        await goal.result()
        [listed] = await client.goals()
        stream = await connection.endpoint(COUNT).feedback(goal.goal_id)
        assert stream.info == listed
        assert listed.worker == "a"


class _WithPast(ForwardingEndpoint):
    """A gateway whose server has a history."""

    def __init__(self, inner: Endpoint, *infos: GoalInfo) -> None:
        super().__init__(inner)
        self._infos = infos

    async def past_goals(self, page: PastPage) -> list[GoalInfo]:
        return [info for info in self._infos if page.has(info)]


async def test_pages_have_the_goals_of_gateways_as_well(fleet: FakeFleet) -> None:
    infos = [
        GoalInfo(GoalID(bytes([number]) * 16), number, GoalStatus.ABORTED) for number in (3, 1)
    ]
    note(fleet, numbered(2), numbered(4))
    gateway = fleet.worker("g", is_kept=False)
    async with gateway.serve(_WithPast(server(), *infos)), fleet.connect() as connection:
        endpoint = connection.endpoint(COUNT)
        found = await endpoint.past_goals(PastPage())
        oldest = await endpoint.past_goals(PastPage(limit=2, newest_first=False))
        read: list[GoalInfo] = []
        await endpoint.read_past(GoalQuery(since=2), read.extend)
    assert sorted(info.stamp for info in read) == [2, 3, 4]
    assert [info.stamp for info in found] == [4, 3, 2, 1]
    assert [info.stamp for info in oldest] == [1, 2]


async def test_a_history_that_cannot_be_read_is_a_lost_connection(
    fleet: FakeFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    FakeWorker(fleet.broker, "gone").own(GOAL_ID)
    async with fleet.connect() as connection:
        endpoint = connection.endpoint(COUNT)
        await connection.workers()
        fleet.broker.is_away = True
        with pytest.raises(ConnectionLost, match="the history of the fleet cannot be read"):
            await endpoint.past_goals(PastPage())
        with pytest.raises(ConnectionLost, match=f"the record of goal {GOAL_ID} cannot be read"):
            await endpoint.rerun(GOAL_ID)

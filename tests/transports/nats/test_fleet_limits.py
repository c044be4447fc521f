"""The limits that all workers of a fleet have together, by workers over brokers in memory."""

from __future__ import annotations

import logging
import random
from collections import Counter
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest
from anyio import create_task_group, current_time, fail_after, sleep

from fibaction._runtime.notify import Notifier
from fibaction.words.errors import ProtocolError, StoreError
from fibaction_transports.nats.broker.broker import (
    BrokerStream,
    Message,
    PutError,
    PutFailure,
)
from fibaction_transports.nats.records import (
    Demand,
    KeyEntry,
    KeyShare,
    encode,
    given,
    key_entry,
    next_entry,
)
from fibaction_transports.nats.worker.fleet_limits import FleetLimits, FleetSlots
from fibaction_transports.nats.worker.lease import MemberPart, Membership
from fibaction_transports.nats.worker.lost_workers import LostWorkers
from fibaction_transports.nats.workers import FleetWorkers
from tests.support.memory_broker import (
    MemoryBroker,
    MemoryBrokers,
    MemoryNote,
)
from tests.support.virtual_time import in_virtual_time
from tests.transports.nats.members import LEASE, NAMES, goal, keep, member, staying, waiting

pytestmark = [pytest.mark.anyio, in_virtual_time()]

KEY = b"left"
SUBJECT = NAMES.key("arms", KEY)
IN_TIME = LEASE + 2

# Workers


class Counts:
    """The goals that run in a whole fleet, for each key, and the most at a time."""

    def __init__(self) -> None:
        self.running: Counter[bytes] = Counter()
        self.most: Counter[bytes] = Counter()

    def add(self, key: bytes, number: int) -> None:
        self.running[key] += number
        self.most[key] = max(self.most[key], self.running[key])


class Seat(MemberPart):
    """A worker that wants places, as a scheduler does."""

    def __init__(self, limits: FleetLimits, places: FleetSlots, counts: Counts) -> None:
        self.limits = limits
        self.places = places
        self.broker: Any = limits.broker
        self.counts = counts
        self.running: Counter[bytes] = Counter()
        self.asked: Counter[bytes] = Counter()
        self.times: list[float] = []
        """The times at which places were granted."""
        self.is_dead = False
        self.outlives_fences = False
        """True if its executors do not end in time when it has no lease."""
        self.news = Notifier()
        self.rewrite: Callable[[], None]

    def want(self, count: int = 1, key: bytes = KEY) -> None:
        self.asked[key] = count
        self._note(key)

    def end(self, key: bytes = KEY, *, again: bool = False) -> None:
        """End a goal, and want another place for the next one."""
        self.running[key] -= 1
        self.counts.add(key, -1)
        self.asked[key] += again
        self._note(key)

    def granted(self, key: bytes) -> None:
        assert self.limits.membership.check(), "a place was granted without a lease"
        if not self.is_dead:
            self.asked[key] -= 1
            self.running[key] += 1
            self.counts.add(key, 1)
            self.times.append(current_time())
            self._note(key)
            self.news.notify()

    def fenced(self) -> None:
        if not self.outlives_fences:
            self.lose_all()

    def lose_all(self) -> None:
        """Let go of all goals, as a worker without a lease does."""
        for key in (*self.running, *self.asked):
            self.counts.add(key, -self.running[key])
            self.running[key] = self.asked[key] = 0
            self._note(key)

    def kill(self) -> None:
        self.is_dead = True
        self.broker.is_away = True
        for key, number in self.running.items():
            self.counts.add(key, -number)

    def _note(self, key: bytes) -> None:
        self.places.note(key, self.running[key], self.asked[key])

    async def runs(self, count: int = 1, key: bytes = KEY, within: float = 5) -> None:
        """Wait until so many goals run here."""
        with fail_after(within):
            while self.running[key] != count:
                await self.news.wait()


@asynccontextmanager
async def seat(
    shared: MemoryBrokers, name: str, counts: Counts | None = None, *, most: int = 1
) -> AsyncGenerator[Seat, None]:
    broker = shared.member(name)
    membership = Membership(broker, NAMES, name, LEASE)
    async with staying(membership) as tasks:
        workers = FleetWorkers(broker, NAMES, tasks, 5)
        await workers.ready()
        repairs: list[Callable[[], None]] = []

        async def open_stream(repair: Callable[[], None]) -> None:
            await broker.flush()
            repairs.append(repair)

        lost = LostWorkers(broker, NAMES, membership, workers)
        limits = FleetLimits(
            broker,
            NAMES,
            membership,
            workers,
            tasks,
            has_ended=lost.has_ended,
            open_stream=open_stream,
        )
        places = await limits.slots("arms", most)
        made = Seat(limits, places, counts or Counts())
        made.rewrite = repairs[0]
        membership.add(made)
        places.open(made.granted)
        try:
            yield made
        finally:
            broker.is_away = False


def holders(entry: KeyEntry) -> dict[str, int]:
    return {one.worker: one.count for one in entry.holders}


def stored(shared: MemoryBrokers) -> KeyEntry | None:
    record = shared.newest(SUBJECT)
    return None if record is None or not record.data else key_entry(record.data)


def writes(shared: MemoryBrokers) -> int:
    return sum(write.subject == SUBJECT for write in shared.writes)


async def test_one_of_two_workers_gets_the_place_and_then_the_other() -> None:
    async with MemoryBrokers() as shared, seat(shared, "a") as a, seat(shared, "b") as b:
        a.want()
        await a.runs()
        b.want()
        await sleep(5)
        assert b.running[KEY] == 0
        a.end()
        await b.runs(within=0.1)
        b.end()
        await sleep(0.1)
        assert stored(shared) is None
        assert not a.limits.turns
        assert not b.limits.turns


async def test_a_place_that_is_not_wanted_any_longer_goes_back() -> None:
    async with MemoryBrokers() as shared, seat(shared, "a", most=2) as a:
        shared.delay = lambda: 0.5
        a.want(2)
        await sleep(1.25)  # it is being written
        a.want(1)
        shared.delay = lambda: 0.0
        await a.runs()
        await sleep(1)
        entry = stored(shared)
        assert entry is not None
        assert (holders(entry), entry.waiting) == ({"a": 1}, ())


async def test_a_long_key_has_a_short_record() -> None:
    async with MemoryBrokers() as shared, seat(shared, "a") as a:
        long, other = b"x" * 10_000, b"x" * 10_001
        a.want(key=long)
        a.want(key=other)
        await a.runs(key=long)
        await a.runs(key=other)
        record = shared.record_of(NAMES.key("arms", long))
        assert len(record.data) < 300


async def test_one_worker_alone_needs_one_write_for_each_goal() -> None:
    async with MemoryBrokers() as shared, seat(shared, "a") as a:
        a.want()
        await a.runs()
        before = writes(shared)
        for _ in range(10):
            a.end(again=True)
            await a.runs(within=0.1)
        assert writes(shared) == before + 10


async def test_a_place_is_found_without_the_hint() -> None:
    async with MemoryBrokers() as shared, seat(shared, "a") as a, seat(shared, "b") as b:
        b.broker.subscriptions.clear()
        a.want()
        await a.runs()
        b.want()
        await sleep(0.5)
        a.end()
        await b.runs(within=1.1)


async def test_a_hint_about_another_key_is_nothing() -> None:
    async with MemoryBrokers() as shared, seat(shared, "a") as a:
        for data in (b"\xff", NAMES.key("arms", b"other").encode()):
            a.limits._on_hint(Message("x", data, ""))
        assert not a.limits.turns


@pytest.mark.promise("FLEET-12")
async def test_a_lost_worker_gives_its_places_back_when_its_lease_ends() -> None:
    async with MemoryBrokers() as shared, seat(shared, "a") as a, seat(shared, "b") as b:
        a.want()
        await a.runs()
        b.want()
        await sleep(0.5)
        a.kill()
        await b.runs(within=IN_TIME)
        assert b.times[0] > b.limits.membership.lease * 0.5


@pytest.mark.promise("FLEET-12")
async def test_a_worker_that_has_lost_its_lease_begins_nothing_by_an_old_place() -> None:
    async with MemoryBrokers() as shared, seat(shared, "a") as a, seat(shared, "b") as b:
        b.want()
        await b.runs()
        a.want()
        await sleep(0.5)
        a.broker.is_away = True
        b.end()
        await sleep(LEASE)
        assert a.times == []
        a.broker.is_away = False
        await sleep(LEASE)
        assert a.times == [], "its goals are those of another worker by now"
        a.want()
        await a.runs()


async def test_an_executor_that_outlives_the_lease_keeps_the_key_busy() -> None:
    async with MemoryBrokers() as shared, seat(shared, "a") as a, seat(shared, "b") as b:
        a.outlives_fences = True
        a.want()
        await a.runs()
        a.broker.is_away = True
        await sleep(2 * LEASE)
        a.broker.is_away = False
        await sleep(LEASE)
        b.want()
        await sleep(3)
        assert b.times == []
        a.end()
        await b.runs()


# Doubt


class Late:
    """Lets the writes of a key have no answer in time, and lands them later."""

    def __init__(self, broker: MemoryBroker, monkeypatch: pytest.MonkeyPatch) -> None:
        self.landing: list[Callable[[], None]] = []
        self.is_on = True
        put = MemoryBroker.put

        def late(one: MemoryBroker, subject: str, data: bytes, **rest: Any) -> None:
            if not self.is_on or one is not broker or subject != SUBJECT:
                put(one, subject, data, **rest)
                return
            then = rest.pop("then")
            self.landing.append(lambda: put(one, subject, data, **rest, then=lambda _answer: None))
            one.shared.at(
                current_time() + 1, lambda: then(PutError(PutFailure.UNKNOWN, "no answer"))
            )

        monkeypatch.setattr(MemoryBroker, "put", late)

    def land(self) -> None:
        for act in self.landing:
            act()


async def test_a_place_is_not_used_while_a_write_that_gives_it_back_may_land(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    counts = Counts()
    async with (
        MemoryBrokers() as shared,
        seat(shared, "a", counts) as a,
        seat(shared, "b", counts) as b,
    ):
        a.want()
        await a.runs()
        late = Late(a.broker, monkeypatch)
        a.end()
        await sleep(0.5)
        a.want()  # the record says still that it has the place
        await sleep(1.5)
        assert a.running[KEY] == 0
        b.want()
        late.land()
        late.is_on = False
        await sleep(5)
        assert counts.most[KEY] == 1
        assert counts.running[KEY] == 1


async def test_an_old_record_of_a_broker_that_is_behind_gives_no_place() -> None:
    async with MemoryBrokers() as shared, seat(shared, "a") as a, seat(shared, "b") as b:
        a.want()
        await a.runs()
        old = shared.newest(SUBJECT)
        a.end(again=True)
        await a.runs()
        b.want()
        await sleep(0.1)
        a.broker.old[SUBJECT] = [old, old]
        a.end(again=True)
        await b.runs()
        assert a.running[KEY] == 0


async def test_an_old_record_gives_no_place_to_a_worker_that_has_none_any_longer() -> None:
    async with MemoryBrokers() as shared, seat(shared, "a") as a, seat(shared, "b") as b:
        a.want()
        await a.runs()
        old = shared.newest(SUBJECT)
        a.end()
        await sleep(0.1)
        b.want()
        await b.runs()
        a.broker.old[SUBJECT] = [old]
        a.want()
        await sleep(3)
        assert a.running[KEY] == 0
        b.end()
        await a.runs()


@pytest.mark.parametrize("fault", [PutFailure.FULL, PutFailure.TOO_LARGE])
async def test_without_room_at_the_brokers_goals_wait_and_a_warning_says_so(
    fault: PutFailure, caplog: pytest.LogCaptureFixture
) -> None:
    async with MemoryBrokers() as shared, seat(shared, "a") as a:
        most, a.broker.max_record = a.broker.max_record, 10
        if fault is PutFailure.FULL:
            shared.is_full = True
        with caplog.at_level(logging.WARNING, "fibaction.nats"):
            a.want()
            await sleep(1.5)
        assert "the slots of a key are not stored, and its goals wait: maximum" in caplog.text
        assert a.running[KEY] == 0
        shared.is_full, a.broker.max_record = False, most
        await a.runs()


async def test_a_record_that_cannot_be_read_is_replaced_after_the_time_of_a_lease(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with MemoryBrokers() as shared, seat(shared, "a") as a:
        shared.put(SUBJECT, b"\xc1", 0, 9e9)
        a.want()
        await a.runs()
        assert "the record of slots of a key of the fleet cannot be read" in caplog.text


# Lost streams


@pytest.mark.promise("FLEET-12")
async def test_after_the_loss_of_the_records_workers_write_theirs_again() -> None:
    counts = Counts()
    async with (
        MemoryBrokers() as shared,
        seat(shared, "a", counts) as a,
        seat(shared, "b", counts) as b,
    ):
        a.want()
        await a.runs()
        shared.records.pop(SUBJECT)
        shared._sequences["key"] = 0
        made = current_time()
        shared.stream = BrokerStream("second", 0)
        b.want()
        await sleep(1)
        assert b.times == [], "places may be missing in a new stream"
        a.rewrite()
        await sleep(1)
        assert holders(stored(shared) or KeyEntry(KEY)) == {"a": 1}
        shared.stream = BrokerStream("second", current_time() - made)
        await sleep(LEASE)
        shared.stream = BrokerStream("second", current_time() - made)
        await sleep(3)
        assert b.times == []
        a.end()
        await b.runs()
        assert counts.most[KEY] == 1


async def test_an_answer_from_before_the_loss_is_not_believed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    counts = Counts()
    async with (
        MemoryBrokers() as shared,
        seat(shared, "a", counts) as a,
        seat(shared, "b", counts) as b,
    ):
        for _ in range(5):
            a.want()
            await a.runs()
            a.end()
            await sleep(0.1)
        put = MemoryBroker.put

        def slow(one: MemoryBroker, subject: str, data: bytes, *, then: Any, **rest: Any) -> None:
            def later(answer: Any) -> None:
                shared.at(current_time() + 1, lambda: then(answer))

            put(one, subject, data, then=later if subject == SUBJECT else then, **rest)

        monkeypatch.setattr(MemoryBroker, "put", slow)
        a.want()
        await sleep(0.5)  # it is stored, and not answered
        monkeypatch.undo()
        shared.records.pop(SUBJECT)
        shared._sequences["key"] = 0
        shared.stream = BrokerStream("second", 0)
        b.want()
        await sleep(0.1)
        a.rewrite()
        await sleep(3)
        shared.stream = BrokerStream("second", LEASE)
        await sleep(3)
        assert counts.most[KEY] == counts.running[KEY] == 1


# The limits of a worker


async def test_two_schedules_of_a_worker_cannot_have_the_same_limit() -> None:
    async with MemoryBrokers() as shared, seat(shared, "a") as a:
        again = await a.limits.slots("arms", 1)
        assert again is a.places
        with pytest.raises(ValueError, match="give their servers the same Schedule object"):
            again.open(print)
        again.close()
        again.open(print)


async def test_goals_that_wait_for_a_place_do_not_go_round_the_workers() -> None:
    async with (
        MemoryBrokers() as shared,
        seat(shared, "b") as b,
        member(shared, "a", key_slots=b.limits.slots) as a,
    ):
        a.begins = False
        assert await a.journal.key_slots("arms", 1) is b.places
        a.accept(waiting(1))
        keep(shared, goal(2, is_running=False, attempt=0))
        shared.notes.append(MemoryNote(NAMES.left("count"), bytes(goal(2).goal_id)))
        shared.notes_changed.notify()
        await a.claims(1)
        await sleep(5)
        assert shared.notes == []


async def test_a_limit_waits_for_brokers_that_are_away_for_the_time_of_a_lease() -> None:
    async with MemoryBrokers() as shared, seat(shared, "a") as a:
        a.limits._hints = None
        a.broker.is_away = True
        with pytest.raises(StoreError, match="cannot join the fleet: fleet_limit='x' cannot be"):
            await a.limits.slots("x", 1)
        shared.at(current_time() + 1, lambda: setattr(a.broker, "is_away", False))
        places = await a.limits.slots("x", 1)
        assert places.most == 1


async def test_the_lease_may_end_while_the_record_is_read() -> None:
    async with MemoryBrokers() as shared, seat(shared, "a") as a:

        async def fence(_call: str, subject: str) -> None:
            if subject == SUBJECT:
                a.broker.before = nothing_more
                a.limits.membership._fence("the test says so")

        async def nothing_more(_call: str, _subject: str) -> None:
            pass

        a.broker.before = fence
        a.outlives_fences = True
        a.want()
        await sleep(1)
        assert a.times == []
        await a.runs(within=LEASE)


# Everything at once


@pytest.mark.promise("FLEET-12")
@pytest.mark.parametrize("seed", range(12))
async def test_no_key_has_too_many_goals_and_each_worker_has_its_turn(seed: int) -> None:
    chance = random.Random(seed)
    most = chance.choice([1, 1, 2, 3])
    counts = Counts()
    keys = [b"left", b"right"]
    async with MemoryBrokers() as shared:
        shared.delay = lambda: chance.uniform(0, chance.choice([0.001, 0.05]))
        shared.loses_answer = lambda write: ".key." in write.subject and chance.random() < 0.05

        async def work(name: str, goals: int) -> None:
            async with seat(shared, name, counts, most=most) as one:

                async def series(key: bytes) -> None:
                    done = 0
                    one.want(key=key)
                    while done < goals:
                        if one.running[key]:
                            await sleep(chance.uniform(0, 0.3))
                            if one.running[key]:  # else it was fenced
                                done += 1
                                one.end(key)
                        else:
                            if not one.asked[key]:
                                one.want(key=key)
                            await sleep(0.02)
                    one.want(0, key=key)

                async with create_task_group() as tasks:
                    for key in keys:
                        tasks.start_soon(series, key)
                    if chance.random() < 0.5:
                        await sleep(chance.uniform(0, 5))
                        one.broker.is_away = True
                        await sleep(chance.choice([0.5, LEASE / 2, 2 * LEASE]))
                        one.broker.is_away = False
                with fail_after(60):  # several answers in a row may be lost, each for two seconds
                    while one.limits.turns:  # noqa: ASYNC110  # nothing tells of their end
                        await sleep(0.1)

        with fail_after(600):
            async with create_task_group() as tasks:
                for number in range(4):
                    tasks.start_soon(work, f"w{number}", 15)
    assert all(counts.most[key] <= most for key in keys), counts.most
    assert not any(counts.running.values())


# The record of a key: who has its places, and who is next


def share(name: str, count: int = 1) -> KeyShare:
    return KeyShare(name, name.encode(), count)


def wants(name: str, running: int = 0, asked: int = 1) -> Demand:
    return Demand(name, name.encode(), running, asked)


def counts(shares: tuple[KeyShare, ...]) -> dict[str, int]:
    return {one.worker: one.count for one in shares}


A, B, C = share("a"), share("b"), share("c")


@pytest.mark.parametrize(
    ("before", "demand", "gone", "most", "holders", "queue"),
    [
        pytest.param(((), ()), wants("a", asked=3), "", 2, {"a": 2}, {"a": 1}, id="free"),
        pytest.param(
            ((A,), (share("b", 2), share("c", 2))),
            wants("a"),
            "",
            3,
            {"a": 1, "b": 1, "c": 1},
            {"b": 1, "c": 1},
            id="by turns",
        ),
        pytest.param(
            ((A,), (B,)), wants("a"), "", 1, {"b": 1}, {"a": 1}, id="behind the others after an end"
        ),
        pytest.param(
            ((share("z"),), (A, B)),
            wants("a", asked=5),
            "",
            1,
            {"z": 1},
            {"a": 5, "b": 1},
            id="its turn is kept",
        ),
        pytest.param(((A,), (A, B)), wants("a", asked=0), "", 1, {"b": 1}, {}, id="no demand"),
        pytest.param(((B,), ()), wants("b", asked=0), "", 1, {}, {}, id="empty"),
        pytest.param(((A,), (B, C)), wants("c"), "ab", 1, {"c": 1}, {}, id="lost workers"),
        pytest.param(
            ((B,), (C,)),
            wants("a", running=1, asked=0),
            "",
            1,
            {"a": 1, "b": 1},
            {"c": 1},
            id="above the limit",
        ),
        pytest.param(
            ((A, B), (C,)), wants("b", asked=0), "", 1, {"a": 1}, {"c": 1}, id="down to the limit"
        ),
    ],
)
async def test_places_are_given_by_turns(
    before: tuple[tuple[KeyShare, ...], tuple[KeyShare, ...]],
    demand: Demand,
    gone: str,
    most: int,
    holders: dict[str, int],
    queue: dict[str, int],
) -> None:
    entry = KeyEntry(KEY, *before)
    after = next_entry(entry, demand, {one.encode() for one in gone}, most, gives=True)
    assert (counts(after.holders), list(counts(after.waiting).items())) == (
        holders,
        list(queue.items()),
    )
    assert after.is_empty == (not holders and not queue)
    assert given(entry, after) == [one for one in holders if one not in counts(entry.holders)]


async def test_in_a_new_stream_nobody_gets_a_place() -> None:
    entry = next_entry(KeyEntry(KEY), wants("a"), set(), 1, gives=False)
    assert (entry.holders, counts(entry.waiting), entry.gives_none) == ((), {"a": 1}, True)
    assert key_entry(encode(entry)) == entry


async def test_another_record_is_an_error() -> None:
    with pytest.raises(ProtocolError, match="the record of slots of a key"):
        key_entry(b"\xc1")

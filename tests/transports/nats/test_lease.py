"""The lease of a worker: when it is renewed, also by a thread, when it ends, and whose it is."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest
from anyio import current_time, sleep

from fibaction.words.errors import TransportError
from fibaction_transports.nats.broker.broker import BrokerAway, BrokerRecord, PutError
from fibaction_transports.nats.records import LeaseEntry, encode, lease_entry
from fibaction_transports.nats.worker.lease import MemberPart, Membership, Term
from tests.support.memory_broker import MemoryBroker, MemoryBrokers
from tests.support.virtual_time import in_virtual_time
from tests.transports.nats.members import LEASE, NAMES, staying

pytestmark = [pytest.mark.anyio, in_virtual_time()]
MARGIN = 1.2


class Member(Membership, MemberPart):
    """A membership that notes its fences, and has a number of goals."""

    def __init__(self, broker: MemoryBroker, name: str = "robot") -> None:
        super().__init__(broker, NAMES, name, LEASE)
        self.fences: list[float] = []
        self.joins: list[float] = []
        self.goals = 0
        self.add(self)

    def describe(self, entry: LeaseEntry) -> None:
        entry.goals = self.goals

    def fenced(self) -> None:
        self.fences.append(current_time())

    def joined(self) -> None:
        self.joins.append(current_time())


@asynccontextmanager
async def joined(broker: MemoryBroker, name: str = "robot") -> AsyncGenerator[Member, None]:
    member = Member(broker, name)
    async with staying(member):
        yield member


def lease(shared: MemoryBrokers, name: str = "robot") -> Any:
    record = shared.newest(NAMES.worker(name))
    return None if record is None or not record.data else lease_entry(record.data)


def puts(shared: MemoryBrokers, name: str = "robot") -> int:
    return sum(write.subject == NAMES.worker(name) for write in shared.writes)


# The term


async def test_a_term_counts_from_before_the_first_write_that_may_be_stored() -> None:
    term = Term(10)
    term.sent(100)
    term.sent(101)
    term.stored()
    assert term.valid_until == 108
    assert term.renew_at == pytest.approx(100 + 10 / 3)
    term.sent(105)
    term.stored()
    assert term.valid_until == 113
    term.end()
    assert term.valid_until < 0


# Stay


async def test_a_lease_is_renewed_three_times_in_its_time() -> None:
    async with MemoryBrokers() as shared, joined(shared.member()) as member:
        first, began = member.incarnation, current_time()
        await sleep(10 * LEASE + 0.1)
        assert puts(shared) == 31
        assert member.incarnation == first
        assert not member.fences
        assert began + 10 * LEASE + LEASE - MARGIN - 0.1 <= member.valid_until
        entry = lease(shared)
        assert (entry.worker, entry.incarnation, entry.lease) == ("robot", first, LEASE)


async def test_a_worker_without_answers_is_fenced_a_margin_before_its_lease_ends() -> None:
    async with MemoryBrokers() as shared, joined(shared.member()) as member:
        valid_until = member.valid_until
        member._broker.is_away = True  # type: ignore[attr-defined]
        await sleep(LEASE + 0.1)
        assert member.fences == [pytest.approx(valid_until)]
        assert not member.incarnation
        assert lease(shared) is None, "the brokers have ended the lease later"


async def test_a_renewal_whose_answer_is_lost_counts_from_when_it_was_sent() -> None:
    async with MemoryBrokers() as shared, joined(shared.member()) as member:
        lost: list[float] = []

        def lose(_: object) -> bool:
            lost.append(current_time())
            return True

        shared.loses_answer = lose
        await sleep(LEASE / 3 + 2.1)
        assert len(lost) == 2, "the lease was found to be stored, and is renewed again"
        assert not member.fences
        assert member.valid_until == pytest.approx(lost[0] + LEASE - MARGIN)


async def test_a_lease_that_cannot_be_read_is_no_reason_to_give_it_up() -> None:
    async with MemoryBrokers() as shared:
        broker = shared.member()
        async with joined(broker) as member:
            subject, cuts = NAMES.worker("robot"), [1]
            old = [shared.newest(subject), None]

            async def away(call: str, _subject: str) -> None:
                if call == "get" and cuts:
                    cuts.pop()
                    raise BrokerAway("on purpose")

            broker.before, broker.old = away, {subject: old}
            shared.loses_answer = lambda _: len(shared.writes) == 2
            await sleep(LEASE)
            assert not old
            assert not member.fences


async def test_a_full_stream_is_tried_again_until_the_lease_ends(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with MemoryBrokers() as shared, joined(shared.member()) as member:
        shared.is_full = True
        with caplog.at_level(logging.WARNING, "fibaction.nats"):
            await sleep(LEASE)
        assert len(member.fences) == 1
        assert "the lease is not renewed: maximum bytes exceeded" in caplog.text
        shared.is_full = False
        await sleep(2)
        assert member.incarnation


@pytest.mark.parametrize("other", [encode(LeaseEntry("robot", b"other")), b"rubbish"])
async def test_a_worker_is_fenced_when_another_one_has_its_lease(other: bytes) -> None:
    async with MemoryBrokers() as shared, joined(shared.member()) as member:
        shared.store(NAMES.worker("robot"), other, LEASE)
        await sleep(LEASE / 3 + 0.1)
        assert len(member.fences) == 1
        assert not member.joins
        await sleep(2 * LEASE)
        assert len(member.joins) == 1, "the other lease has ended"


# Changes


async def test_changes_are_stored_at_most_once_a_second() -> None:
    async with MemoryBrokers() as shared, joined(shared.member()) as member:
        before = puts(shared)
        for _ in range(20):
            member.goals += 1
            member.note_change()
            await sleep(0.1)
        await sleep(1)
        assert puts(shared) - before <= 4
        entry = lease(shared)
        assert entry.goals == 20


async def test_an_update_is_stored_at_once_also_after_another_change() -> None:
    async with MemoryBrokers() as shared, joined(shared.member()) as member:
        member.goals, began = 7, current_time()
        await member.update()
        assert current_time() - began < 0.1
        assert lease(shared).goals == 7


# Names


async def test_a_name_in_use_is_refused_in_one_sentence() -> None:
    async with MemoryBrokers() as shared, joined(shared.member()):
        began = current_time()
        with pytest.raises(TransportError) as caught:
            await Member(shared.member()).join()
        assert str(caught.value) == (
            "the worker name 'robot' is in use in fleet 'test': give this worker another one"
        )
        assert current_time() - began <= LEASE / 3 + 1.1


async def test_a_lease_that_does_not_end_is_given_up() -> None:
    async with MemoryBrokers() as shared:
        shared.put(NAMES.worker("robot"), encode(LeaseEntry("robot", b"other")), 0, 1000)
        with pytest.raises(TransportError, match="the lease of 'robot' does not end"):
            await Member(shared.member()).join()


@pytest.mark.parametrize(
    ("record", "text"),
    [
        (b"rubbish", "the lease of a worker of the fleet cannot be read"),
        (b"full", "maximum bytes"),
        (b"away", "the brokers do not answer"),
    ],
)
async def test_what_is_wrong_at_the_brokers_is_said_in_one_sentence(
    record: bytes, text: str
) -> None:
    async with MemoryBrokers() as shared:
        broker = shared.member()
        shared.is_full, broker.is_away = record == b"full", record == b"away"
        if record == b"rubbish":
            shared.put(NAMES.worker("robot"), record, 0, 1000)
        with pytest.raises(TransportError, match=f"cannot join the fleet: {text}"):
            await Member(broker).join()


# Leave


@pytest.mark.parametrize("is_clean", [True, False])
async def test_a_worker_that_leaves_ends_its_lease(*, is_clean: bool) -> None:
    async with MemoryBrokers() as shared:
        async with joined(shared.member()) as member:
            pass
        await member.leave(is_clean=is_clean)
        record = shared.record_of(NAMES.worker("robot"))
        if is_clean:
            assert not lease_entry(record.data).incarnation
            assert not lease_entry(record.data).cleared_by
        else:
            assert not record.data
        async with joined(shared.member()):
            pass


async def test_leaving_ends_nothing_that_another_worker_has() -> None:
    async with MemoryBrokers() as shared:
        member = Member(shared.member())
        await member.join()
        await sleep(LEASE + 0.1)
        async with joined(shared.member()) as other:
            await member.leave(is_clean=True)
            entry = lease(shared)
            assert entry.incarnation == other.incarnation
            await member.leave(is_clean=True)  # it has left already


# Time that passes in between


async def test_a_worker_that_is_fenced_while_it_reads_its_lease_joins_again() -> None:
    async with MemoryBrokers() as shared:
        broker = shared.member()
        async with joined(broker) as member:
            first = member.incarnation

            async def fence(call: str, _subject: str) -> None:
                if call == "get" and not member.fences:
                    member._fence("on purpose")

            broker.before = fence
            shared.loses_answer = lambda _: len(shared.writes) == 2
            await sleep(3 * LEASE)
            assert len(member.fences) == len(member.joins) == 1
            assert member.incarnation not in (b"", first)


async def test_a_lease_that_has_ended_when_its_answer_comes_is_stored_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with MemoryBrokers() as shared:
        member = Member(shared.member())
        put, freezes = member._put, [LEASE]

        async def frozen(*arguments: Any) -> Any:
            stored = await put(*arguments)
            await sleep(freezes.pop() if freezes else 0)
            return stored

        monkeypatch.setattr(member, "_put", frozen)
        await member.join()
        assert puts(shared) == 2
        assert current_time() < member.valid_until
        assert not member.fences


# The lease of a worker whose event loop is blocked


async def blocked(shared: MemoryBrokers, name: str = "robot") -> Membership:
    """Return a membership whose event loop does nothing for it."""
    member = Membership(shared.member(), NAMES, name, LEASE)
    await member.join()
    return member


async def help_for(seconds: float, member: Membership, broker: MemoryBroker) -> int:
    """Do what the thread does; return how often it has renewed the lease."""
    count, end = 0, current_time() + seconds
    while current_time() < end:
        await sleep(LEASE / 16)
        if member.is_blocked(current_time()):
            await member.renew_blocked(broker)
            count += 1
    return count


async def test_a_lease_is_kept_while_the_event_loop_is_blocked_and_after_it() -> None:
    async with MemoryBrokers() as shared:
        member = await blocked(shared)
        first = member.incarnation
        assert 9 < await help_for(5 * LEASE, member, shared.member()) < 16
        assert member.check()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(member.run)
            tasks.start_soon(member.fence_in_time)
            assert await help_for(5 * LEASE, member, shared.member()) == 0, "it runs again"
            tasks.cancel_scope.cancel()
        assert member.incarnation == first


async def test_a_lease_is_kept_after_a_renewal_whose_answer_the_event_loop_has_not_read() -> None:
    async with MemoryBrokers() as shared:
        member = await blocked(shared)
        entry = LeaseEntry("robot", member.incarnation, lease=LEASE)
        shared.put(NAMES.worker("robot"), encode(entry), 1, LEASE)
        assert await help_for(2 * LEASE, member, shared.member())
        assert member.check()


class _Overtaken(MemoryBroker):
    """The connection of a thread whose event loop runs again before its first write arrives."""

    act: Callable[[], Awaitable[object]] | None = None

    async def put_and_wait(self, *args: Any, **options: Any) -> int | PutError:
        if self.act is not None:
            act, self.act = self.act, None
            await act()
        return await super().put_and_wait(*args, **options)


async def overtaken_by(act: Callable[[Membership], Awaitable[object]]) -> BrokerRecord:
    """Return the lease after a thread's renewal that the event loop has overtaken."""
    async with MemoryBrokers() as shared:
        member = await blocked(shared)
        broker = _Overtaken(shared, "thread")
        broker.act = lambda: act(member)
        await member.renew_blocked(broker)
        record = shared.record_of(NAMES.worker("robot"))
        return record


class _Room(MemberPart):
    def describe(self, entry: LeaseEntry) -> None:
        entry.has_room = True


async def test_a_thread_writes_no_older_lease_over_one_that_the_event_loop_has_stored() -> None:
    async def make_room(member: Membership) -> None:
        member.add(_Room())
        assert await member._renewed(member.incarnation)

    async def leave(member: Membership) -> None:
        member.incarnation, again = b"", member.incarnation
        await member._put(LeaseEntry("robot", again), member._sequence)

    async def fenced(member: Membership) -> None:
        member.incarnation = b""

    assert lease_entry((await overtaken_by(make_room)).data).has_room
    assert (await overtaken_by(fenced)).sequence == 2  # its lease is not longer for that
    assert (await overtaken_by(leave)).sequence == 2  # and nothing is written after it


async def test_a_lease_that_has_ended_is_not_renewed_and_the_reason_is_told(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with MemoryBrokers() as shared:
        member = await blocked(shared)
        shared.put(NAMES.worker("robot"), b"", 1, LEASE)  # it was cleared up after
        await help_for(2 * LEASE, member, shared.member())
        record = shared.record_of(NAMES.worker("robot"))
        assert record.data == b""
        assert not member.check()
        assert "its event loop has not run for 12.0 s" in caplog.text


async def test_a_worker_that_does_not_reach_the_brokers_is_not_helped() -> None:
    async with MemoryBrokers() as shared:
        member = await blocked(shared)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(member.run)
            tasks.start_soon(member.fence_in_time)
            member._broker.is_away = True  # type: ignore[attr-defined]  # in memory
            assert await help_for(2 * LEASE, member, shared.member()) == 0
            tasks.cancel_scope.cancel()
        assert not member.incarnation

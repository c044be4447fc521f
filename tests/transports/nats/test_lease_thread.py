"""The lease of a worker whose event loop is blocked."""

from __future__ import annotations

import threading
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest
from anyio import current_time, sleep
from anyio.lowlevel import current_token

from fibaction import Action, ActionServer, GoalHandle, connect, serve
from fibaction_transports.nats.broker.broker import Broker, BrokerAway, BrokerRecord, PutError
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import LeaseEntry, encode, lease_entry
from fibaction_transports.nats.worker.lease import MemberPart, Membership
from fibaction_transports.nats.worker.lease_thread import lease_thread
from tests.support.memory_broker import MemoryBroker, MemoryBrokers
from tests.support.nats_server import NatsServer
from tests.support.virtual_time import in_virtual_time

NAMES = FleetNames("test")
LEASE = 6.0
WAIT = Action("wait", goal=float, feedback=int, result=str)
virtual = in_virtual_time()


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


@virtual
@pytest.mark.anyio
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


@virtual
@pytest.mark.anyio
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
        record = shared.newest(NAMES.worker("robot"))
        assert record is not None
        return record


class _Room(MemberPart):
    def describe(self, entry: LeaseEntry) -> None:
        entry.has_room = True


@virtual
@pytest.mark.anyio
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


@virtual
@pytest.mark.anyio
async def test_a_lease_that_has_ended_is_not_renewed_and_the_reason_is_told(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with MemoryBrokers() as shared:
        member = await blocked(shared)
        shared.put(NAMES.worker("robot"), b"", 1, LEASE)  # it was cleared up after
        await help_for(2 * LEASE, member, shared.member())
        record = shared.newest(NAMES.worker("robot"))
        assert record is not None
        assert record.data == b""
        assert not member.check()
        assert "its event loop has not run for 12.0 s" in caplog.text


@virtual
@pytest.mark.anyio
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


# The thread


class _AlwaysBlocked(Membership):
    def is_blocked(self, now: float) -> bool:
        return True


def _membership() -> Membership:
    return _AlwaysBlocked(MemoryBroker(MemoryBrokers(), "a"), NAMES, "robot", 0.05)


@pytest.mark.anyio
async def test_a_thread_that_does_not_reach_the_brokers_tells_it_and_tries_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    again = threading.Event()
    tries: list[None] = []

    @asynccontextmanager
    async def away() -> AsyncGenerator[Broker, None]:
        tries.append(None)
        if len(tries) == 2:
            again.set()
        raise BrokerAway("no broker answers")
        yield  # pragma: no cover

    async with lease_thread(_membership(), away):
        assert again.wait(10)
    assert "worker 'robot': the lease is not renewed: no broker answers" in caplog.text
    assert caplog.text.count("its event loop is blocked") == 1


@pytest.mark.anyio
async def test_a_worker_without_threads_says_what_it_has_not(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_self: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", fail)
    async with lease_thread(_membership(), lambda: pytest.fail("it is not needed")):
        pass
    assert "goals that block worker 'robot' are lost for it: can't start" in caplog.text


@pytest.mark.anyio
async def test_a_thread_that_is_renewing_the_lease_at_the_end_does_not_block_the_event_loop() -> (
    None
):
    renews, may_end = threading.Event(), threading.Event()

    @asynccontextmanager
    async def slow() -> AsyncGenerator[Broker, None]:
        renews.set()
        assert may_end.wait(10)
        raise BrokerAway("no broker answers")
        yield  # pragma: no cover

    async with anyio.create_task_group() as tasks:
        async with lease_thread(_membership(), slow):
            assert renews.wait(10)
            tasks.start_soon(anyio.to_thread.run_sync, may_end.set)
        assert may_end.is_set()


def _in_thread(function: Callable[[], object]) -> threading.Thread:
    thread = threading.Thread(target=function)
    thread.start()
    return thread


@pytest.mark.promise("FLEET-14")
@pytest.mark.anyio
async def test_a_goal_that_blocks_its_worker_for_longer_than_the_lease_runs_once(
    shared_broker: NatsServer, fleet: str
) -> None:
    runs: list[str] = []
    serving = threading.Event()
    ends: list[Callable[[], object]] = []

    async def wait(goal: GoalHandle[float]) -> AsyncGenerator[int | str, None]:
        runs.append(threading.current_thread().name)
        threading.Event().wait(goal.request)  # it blocks the event loop
        yield "done"

    async def work() -> None:
        url = f"{shared_broker.url(fleet)}?lease=2"
        async with serve(ActionServer(WAIT, wait, recovery="rerun", watchdog=0), url):
            stop, token = anyio.Event(), current_token()
            ends.append(lambda: anyio.from_thread.run_sync(stop.set, token=token))
            serving.set()
            await stop.wait()

    first = _in_thread(lambda: anyio.run(work, backend="asyncio"))
    assert await anyio.to_thread.run_sync(serving.wait, 20)
    async with connect(shared_broker.url(fleet), WAIT) as client:
        sent = await client.send_goal(5.0)
        async with serve(
            ActionServer(WAIT, wait, recovery="rerun"), f"{shared_broker.url(fleet)}?lease=2"
        ):
            assert (await sent.outcome()).result == "done"
    await anyio.to_thread.run_sync(ends[0])
    await anyio.to_thread.run_sync(first.join)
    assert runs == [first.name]

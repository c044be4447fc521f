"""Fleets with processes of nats-server: lost streams, a full storage, pauses, blocked workers."""

from __future__ import annotations

import secrets
import threading
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import msgspec
import pytest
from anyio.lowlevel import current_token

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    ClientGoal,
    GoalHandle,
    GoalRejected,
    GoalStatus,
    RejectionCode,
    Schedule,
    TransportError,
    connect,
    serve,
)
from fibaction.border.event_loop import Background
from fibaction.words.goal_query import GoalHistory
from fibaction.words.intake import IntakeChange, IntakeMode
from fibaction_transports.nats.broker import jetstream
from fibaction_transports.nats.broker.broker import Broker, BrokerAway
from fibaction_transports.nats.broker.nats_broker import open_broker
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.settings import FleetSettings
from fibaction_transports.nats.worker.lease import Membership
from fibaction_transports.nats.worker.worker import lease_thread
from tests.fleet.workers import Setup, workers
from tests.kills.victim import WORK, Done, Work
from tests.support.memory_broker import MemoryBroker, MemoryBrokers
from tests.support.nats_server import NatsServer, nats_server, needs_nats
from tests.support.virtual_time import in_virtual_time
from tests.transports.hearing import Hearing
from tests.transports.nats.members import NAMES, member

pytestmark = [pytest.mark.anyio]
COUNT = Action("count", goal=int, feedback=str, result=int)
LEASE = 6.0
"""Long enough that a busy machine does not keep a worker from renewing its lease in time."""
IN_TIME = LEASE + 2


class Worker:
    """A worker whose goals above 0 end when the test says so."""

    def __init__(self) -> None:
        self.go = anyio.Event()
        self.attempts: list[tuple[int, int]] = []

    async def count(self, goal: GoalHandle[int]) -> AsyncGenerator[str | int, None]:
        self.attempts.append((goal.request, goal.attempt))
        yield "begun"
        if goal.request:
            await self.go.wait()
        yield goal.request


@asynccontextmanager
async def serving(url: str, **settings: Any) -> AsyncGenerator[Worker, None]:
    worker = Worker()
    server = ActionServer(COUNT, worker.count, recovery="rerun", **settings)
    async with serve(server, url):
        yield worker


async def delete(server: NatsServer, *streams: str) -> None:
    """Delete streams as an operator does."""
    async with open_broker(FleetSettings("x", (server.address,))) as broker:
        for stream in streams:
            await jetstream.call(broker, f"STREAM.DELETE.{stream}")


async def renewals(server: NatsServer, names: FleetNames, count: int) -> None:
    """Wait until workers have renewed their leases so many times."""
    async with open_broker(FleetSettings("x", (server.address,))) as broker:
        async with broker.watch(names.workers, names.worker()) as watch:
            with anyio.fail_after(30):
                while count > 0:
                    count -= len(await watch.next() or ())


async def all_know(log: Hearing, count: int, streams: list[str]) -> None:
    """Wait until so many workers have told the loss of each stream."""
    for stream in streams:
        await log.told(f"the stream {stream} was lost", count)


Names = Callable[[FleetNames], str]
ALL: list[Names] = [
    lambda names: names.goals,
    lambda names: names.workers,
    lambda names: names.notes,
]


@pytest.mark.promise("FLEET-8")
async def test_a_fleet_goes_on_when_streams_are_deleted(
    shared_broker: NatsServer, log: Hearing
) -> None:
    # Four fleets at once: each is watched for longer than a lease.
    async with anyio.create_task_group() as tasks:
        for lost in (ALL[:1], ALL[1:2], ALL[2:], ALL):
            tasks.start_soon(a_fleet_goes_on_without, lost, shared_broker, log)
    assert not [line for line in log.warnings if "is gone" in line or "gives up" in line]


async def a_fleet_goes_on_without(
    lost: list[Names],
    broker: NatsServer,
    log: Hearing,
    lose: Callable[..., Awaitable[None]] = delete,
) -> None:
    fleet = secrets.token_hex(4)
    names, url = FleetNames(fleet), broker.url(fleet, f"?lease={LEASE:g}")
    streams = [one(names) for one in lost]
    async with (
        serving(url) as one,
        serving(url) as two,
        connect(broker.url(fleet)) as connection,
    ):
        client = ActionClient(connection.endpoint(COUNT), COUNT)
        goals = [await client.send_goal(number) for number in (1, 2, 3, 4)]
        await lose(broker, *streams)
        await all_know(log, 2, streams)
        with anyio.fail_after(IN_TIME):
            assert await client.call(0) == 0
        await renewals(broker, names, 8)  # for longer than a lease
        for worker in (one, two):
            worker.go.set()
        with anyio.fail_after(30):
            assert [await goal.result() for goal in goals] == [1, 2, 3, 4]
    assert sorted(one.attempts + two.attempts) == [(number, 1) for number in range(5)]


@pytest.mark.promise("FLEET-8")
async def test_a_fleet_goes_on_when_its_broker_comes_back_without_its_storage(
    own_broker: NatsServer, log: Hearing
) -> None:
    async def lose(_broker: NatsServer, *_streams: str) -> None:
        own_broker.kill()
        own_broker.lose_data()
        own_broker.start()

    await a_fleet_goes_on_without(ALL, own_broker, log, lose)


@pytest.mark.promise("FLEET-8")
async def test_goals_of_a_lost_worker_are_taken_over_in_time_when_the_notes_were_deleted(
    shared_broker: NatsServer, fleet: str, log: Hearing, tmp_path: Path
) -> None:
    names, url = FleetNames(fleet), shared_broker.url(fleet, f"?lease={LEASE:g}")
    setup = Setup("lost", f"{url}&worker=lost", str(tmp_path / "diary"), "rerun")

    async def work(goal: GoalHandle[Work]) -> AsyncGenerator[Done, None]:
        yield Done(goal.request.steps, goal.attempt)

    async with workers(setup) as [lost], connect(shared_broker.url(fleet)) as connection:
        client = ActionClient(connection.endpoint(WORK), WORK)
        goals = [await client.send_goal(Work(number, 99)) for number in (1, 2, 3)]
        async with serve(ActionServer(WORK, work, recovery="rerun"), url):
            await delete(shared_broker, names.notes)
            await all_know(log, 1, [names.notes])
            lost.kill()
            with anyio.fail_after(IN_TIME):
                for goal, number in zip(goals, (1, 2, 3), strict=True):
                    assert await goal.result() == Done(number, 2)


@pytest.mark.promise("FLEET-8", "FLEET-12")
async def test_a_goal_keeps_its_place_when_the_stream_of_the_places_is_lost(
    shared_broker: NatsServer, fleet: str, log: Hearing
) -> None:
    names, url = FleetNames(fleet), shared_broker.url(fleet, f"?lease={LEASE:g}")

    def limit() -> Schedule:
        return Schedule(key=lambda _: "arm", concurrency=1, queue=99, fleet_limit="arms")

    async with (
        serving(url, schedule=limit()) as one,
        serving(url, schedule=limit()) as two,
        connect(shared_broker.url(fleet), COUNT) as client,
    ):
        goals = [await client.send_goal(1)]
        with anyio.fail_after(LEASE + 5):
            assert await anext(goals[0].feedback) == "begun"
        goals += [await client.send_goal(number) for number in (2, 3, 4, 5)]
        await delete(shared_broker, names.keys)
        await log.told(f"the stream {names.keys} was lost, and with it the slots of keys", 2)
        await renewals(shared_broker, names, 8)  # for longer than a lease
        assert one.attempts + two.attempts == [(1, 1)]
        for worker in (one, two):
            worker.go.set()
        with anyio.fail_after(20):
            assert [await goal.result() for goal in goals] == [1, 2, 3, 4, 5]


@in_virtual_time()
async def test_a_stream_that_was_opened_for_several_limits_is_made_again_once() -> None:
    async with MemoryBrokers() as shared, member(shared, "a") as a:
        await a.streams.open()
        for _ in range(3):
            await a.streams.open_keys(lambda: None)
        made: list[str] = []

        async def note(call: str, subject: str) -> None:
            if call == "create_streams":
                made.append(subject)

        a.broker.before = note
        shared.stream = None
        async with Background() as tasks:
            tasks.start_soon(a.streams.run)
            await anyio.sleep(0.5)  # of virtual time: the first look, and no second one
        assert made == ["keys"]


@in_virtual_time()
async def test_a_stream_that_could_not_be_opened_is_not_made_with_those_that_are_lost() -> None:
    async def refuse(call: str, subject: str) -> None:
        if call == "create_streams":
            raise TransportError("there is no room for it")

    async def refuse_keys(_call: str, subject: str) -> None:
        assert subject != "keys"

    async with MemoryBrokers() as shared, member(shared, "a") as a:
        a.broker.before = refuse
        with pytest.raises(TransportError):
            await a.streams.open_keys(lambda: None)
        with pytest.raises(TransportError):
            await a.streams.open_history(GoalHistory())
        a.broker.before = refuse_keys
        await a.streams._make(a.streams._more)
        assert shared.history is None


# A fleet whose broker has little storage, which the goals of one client fill


class Load(msgspec.Struct):
    weight: bytes = b""


CARRY = Action("carry", goal=Load, feedback=str, result=int)
LARGE = Load(bytes(300_000))


@pytest.mark.promise("FLEET-9")
@needs_nats
async def test_a_client_that_fills_the_broker_is_told_busy_and_harms_no_goal() -> None:
    go = anyio.Event()

    async def carry(goal: GoalHandle[Load]) -> AsyncGenerator[str | int, None]:
        if goal.request.weight:
            await go.wait()
        yield len(goal.request.weight)

    with (
        anyio.fail_after(120),
        nats_server("jetstream: {max_file_store: 16MB}") as broker,
    ):
        async with (
            serve(ActionServer(CARRY, carry), broker.url("full", "?worker=a")),
            serve(ActionServer(CARRY, carry), broker.url("full", "?worker=b")),
            connect(broker.url("full"), CARRY) as flood,
            connect(broker.url("full"), CARRY) as honest,
        ):
            accepted: list[ClientGoal[str, int]] = []
            rejected: list[GoalRejected] = []
            for _ in range(40):
                try:
                    accepted.append(await flood.send_goal(LARGE))
                except GoalRejected as error:
                    rejected.append(error)
                    assert await honest.call(Load()) == 0
            assert all(error.is_busy for error in rejected)
            assert len(accepted) >= 2
            assert "fleet 'full' keep no more goals: maximum bytes exceeded" in rejected[0].reason
            assert "(stream FIB_full_GOALS)" in rejected[0].reason
            go.set()
            for goal in accepted:
                outcome = await goal.outcome()
                assert (outcome.status, outcome.result) == (GoalStatus.SUCCEEDED, 300_000)
            # What they had taken is free again.
            assert [await flood.call(LARGE) for _ in range(20)] == [300_000] * 20
            async with connect(broker.url("full")) as connection:
                assert {one.name for one in await connection.workers()} == {"a", "b"}


# A fleet whose action is paused, and one of whose workers drains, with a broker of NATS


MOVE = Action("move", goal=str, feedback=int, result=str)
REFUSE = IntakeChange(IntakeMode.REFUSE, "wet floor", "ann")
HOLD, OPEN = IntakeChange(IntakeMode.HOLD), IntakeChange(IntakeMode.OPEN)


@asynccontextmanager
async def movers(url: str, *names: str) -> AsyncGenerator[None, None]:
    def move(name: str) -> Any:
        async def executor(goal: GoalHandle[str]) -> AsyncGenerator[int | str, None]:
            yield 1
            yield name

        return executor

    async with AsyncExitStack() as stack:
        for name in names:
            server = ActionServer(MOVE, move(name))
            await stack.enter_async_context(serve(server, f"{url}?worker={name}&lease=4"))
        yield


async def test_a_pause_holds_for_all_workers_and_for_those_that_come_later(
    shared_broker: NatsServer, fleet: str
) -> None:
    url = shared_broker.url(fleet)
    with anyio.fail_after(60):
        async with connect(url, MOVE) as client:
            async with movers(url, "a", "b"):
                await client.wait_for_server()
                assert (await client.endpoint.intake()).mode is IntakeMode.OPEN
                intake = await client.endpoint.change_intake(REFUSE)
                assert len(intake.changes) == 1
                async with movers(url, "c"):
                    for _ in range(6):
                        with pytest.raises(GoalRejected, match="wet floor") as rejected:
                            await client.send_goal("x")
                        assert rejected.value.code is RejectionCode.BUSY
            async with movers(url, "d"):  # all others have gone
                await client.wait_for_server()
                assert await client.endpoint.intake() == intake
                held = await client.endpoint.change_intake(HOLD)
                assert held.mode is IntakeMode.HOLD
                goal = await client.send_goal("x")
                opened = await client.endpoint.change_intake(OPEN)
                assert len(opened.changes) == 3
                assert await goal.result() == "d"


async def test_a_worker_that_drains_gets_no_goals_until_it_is_resumed(
    shared_broker: NatsServer, fleet: str
) -> None:
    url = shared_broker.url(fleet)
    drain = IntakeChange(IntakeMode.DRAIN, worker="a")
    with anyio.fail_after(60):
        async with movers(url, "a", "b"), connect(url, MOVE) as client:
            endpoint = client.endpoint
            assert (await endpoint.change_intake(drain)).mode is IntakeMode.DRAIN
            assert (await endpoint.intake()).mode is IntakeMode.OPEN
            assert {await client.call("x") for _ in range(8)} == {"b"}
            await endpoint.change_intake(IntakeChange(IntakeMode.OPEN, worker="a"))
            await endpoint.change_intake(IntakeChange(IntakeMode.DRAIN, worker="b"))
            assert {await client.call("x") for _ in range(4)} == {"a"}


async def test_a_worker_of_a_paused_fleet_stops_at_once_and_leaves_what_waits_to_the_others(
    shared_broker: NatsServer, fleet: str
) -> None:
    url = shared_broker.url(fleet)

    async def move(goal: GoalHandle[str]) -> AsyncGenerator[int | str, None]:
        yield 1
        yield "moved"

    def server() -> ActionServer[Any, Any, Any]:
        return ActionServer(MOVE, move, at_stop="keep")

    with anyio.fail_after(60):
        async with connect(url, MOVE) as client:
            first = server()
            async with serve(first, f"{url}?worker=a&lease=4"):
                await client.wait_for_server()
                await client.endpoint.change_intake(HOLD)
                goal = await client.send_goal("x")
                await first.drain(timeout=600)
            async with serve(server(), f"{url}?worker=b&lease=4"):
                await client.wait_for_server()
                await client.endpoint.change_intake(OPEN)
                assert await goal.result() == "moved"


# The thread that renews a lease

WAIT = Action("wait", goal=float, feedback=int, result=str)


class _AlwaysBlocked(Membership):
    def is_blocked(self, now: float) -> bool:
        return True


def _membership() -> Membership:
    return _AlwaysBlocked(MemoryBroker(MemoryBrokers(), "a"), NAMES, "robot", 0.05)


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


async def test_a_worker_without_threads_says_what_it_has_not(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_self: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", fail)
    async with lease_thread(_membership(), lambda: pytest.fail("it is not needed")):
        pass
    assert "goals that block worker 'robot' are lost for it: can't start" in caplog.text


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

"""The workers of a fleet, as a client knows them from their leases."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import anyio
import pytest

from fibaction import ConnectionLost, WorkerInfo
from fibaction.border.event_loop import Background
from fibaction_transports.nats.broker.broker import BrokerStream
from fibaction_transports.nats.records import LeaseEntry, encode
from fibaction_transports.nats.workers import FleetWorkers
from tests.support.virtual_time import in_virtual_time
from tests.transports.nats.fake_fleet import COUNT, NAMES, FakeFleet, server
from tests.wire.memory import settled

pytestmark = [pytest.mark.anyio, in_virtual_time()]


@pytest.fixture
def fleet() -> FakeFleet:
    return FakeFleet()


@asynccontextmanager
async def workers_of(fleet: FakeFleet) -> AsyncGenerator[tuple[FleetWorkers, list[str]], None]:
    async with Background() as tasks:
        workers = FleetWorkers(fleet.broker, NAMES, tasks, 5)
        gone: list[str] = []
        workers.when_gone(lambda lease: gone.append(lease.worker))
        await workers.ready()
        yield workers, gone


async def test_workers_are_known_by_their_leases(fleet: FakeFleet) -> None:
    async with (
        fleet.worker("b", is_kept=False).serve(server()),
        fleet.worker("a").serve(server()) as a,
        workers_of(fleet) as (workers, gone),
    ):
        assert workers.infos() == [WorkerInfo(name, ("count",), 1) for name in ("a", "b")]
        assert workers.actions() == [COUNT.info]
        assert [lease.worker for lease in workers.serving("count")] == ["a", "b"]
        assert [lease.worker for lease in workers.serving("count", is_kept=False)] == ["b"]
        assert workers.serving("fly") == []
        assert [workers.is_kept(name, "count") for name in ("a", "b", "c")] == [True, False, True]
        assert workers.has("a", a.incarnation)
        assert not workers.has("a", b"another")
        a.end_lease()
        await settled()
        assert gone == ["a"]
        assert workers.get("a") is None
        a.end_lease()
        await settled()
        assert gone == ["a"]


async def test_a_new_incarnation_is_another_worker(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, workers_of(fleet) as (workers, gone):
        a.renew()
        await settled()
        assert gone == []
        a.incarnation = b"\2" * 8
        a.renew()
        await settled()
        assert gone == ["a"]
        assert workers.has("a", b"\2" * 8)


async def test_a_name_that_is_cleared_up_after_is_not_a_worker(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()), workers_of(fleet) as (workers, gone):
        fleet.broker.store(NAMES.worker("a"), encode(LeaseEntry("a", b"", cleared_by="b")))
        fleet.broker.store(NAMES.worker("c"), b"?")
        await settled()
        assert (gone, workers.infos()) == (["a"], [])


async def test_a_worker_is_gone_once_more_when_the_claim_to_clear_up_after_it_ends(
    fleet: FakeFleet,
) -> None:
    subject = NAMES.worker("a")
    claim, done = encode(LeaseEntry("a", b"", cleared_by="b")), encode(LeaseEntry("a", b""))
    async with fleet.worker("a").serve(server()) as a, workers_of(fleet) as (workers, gone):
        for data in (claim, claim, b""):
            fleet.broker.store(subject, data)
            await settled()
        assert gone == ["a", "a"], "its lease has ended, and then the claim"
        for data in (claim, done, b"", claim):
            fleet.broker.store(subject, data)
            await settled()
        a.renew()
        await settled()
        assert gone == ["a", "a"], "all is done, or another worker has the name"
        a.end_lease()
        fleet.broker.store(subject, claim)
        await settled()
        del fleet.broker.shared.records[subject]
        fleet.broker.begin_anew()
        await settled()
        assert gone == ["a"] * 4
        assert not workers.living()


async def test_workers_that_may_write_their_leases_again_are_not_gone(fleet: FakeFleet) -> None:
    async with (
        fleet.worker("a").serve(server()),
        fleet.worker("b").serve(server()) as b,
        workers_of(fleet) as (workers, gone),
    ):
        fleet.broker.shared.records.clear()
        fleet.broker.shared.stream = BrokerStream("second", workers.longest_lease - 1)
        fleet.broker.begin_anew()
        await anyio.sleep(2)
        assert (gone, len(workers.living())) == ([], 2)
        b.renew()
        fleet.broker.is_away = True
        await anyio.sleep(2)
        fleet.broker.shared.stream = BrokerStream("second", workers.longest_lease)
        assert gone == []
        fleet.broker.is_away = False
        await anyio.sleep(1)
        assert (gone, [lease.worker for lease in workers.living()]) == (["a"], ["b"])


async def test_brokers_that_do_not_answer_are_an_error_after_a_while(fleet: FakeFleet) -> None:
    fleet.broker.is_away = True
    async with Background() as tasks:
        workers = FleetWorkers(fleet.broker, NAMES, tasks, 5)
        began = anyio.current_time()
        with pytest.raises(ConnectionLost, match=r"have not told the workers .* within 5 s"):
            await workers.ready()
        assert anyio.current_time() - began == pytest.approx(5)
        fleet.broker.is_away = False
        await workers.ready()

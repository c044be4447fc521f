"""Goals that are lost at one worker, and go on at another, or end by their record."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import Any

import anyio
import pytest

from fibaction import (
    ClientGoal,
    ConnectionLost,
    GoalRejected,
    GoalStatus,
    ProtocolError,
    ServerNotFound,
    WorkerInfo,
)
from fibaction.border.event_loop import Background
from fibaction_transports.nats.broker.broker import BrokerAway, BrokerStream
from fibaction_transports.nats.client import worker_connections
from fibaction_transports.nats.client.free_workers import (
    FIRST_WAIT,
    OFFER_LIFE,
    RETURN_WAIT,
    ROOM_WAIT,
    RoomFinder,
)
from fibaction_transports.nats.records import LeaseEntry, RoomOffer, encode, question
from fibaction_transports.nats.workers import FleetWorkers
from tests.support.matching import End
from tests.support.memory_broker import Before, nothing
from tests.support.virtual_time import in_virtual_time
from tests.transports.nats.fake_fleet import (
    COUNT,
    ENDED,
    NAMES,
    FakeFleet,
    client_of,
    server,
)
from tests.wire.memory import Running, settled

pytestmark = [pytest.mark.anyio, in_virtual_time()]


@pytest.fixture
def fleet() -> FakeFleet:
    return FakeFleet()


def away_for(name: str) -> Before:
    async def away(call: str, _subject: str) -> None:
        if call == name:
            raise BrokerAway("on purpose")

    return away


async def read_three(goal: ClientGoal[int, str]) -> None:
    assert [await anext(goal.feedback) for _ in range(3)] == [0, 1, 2]


async def test_a_goal_goes_on_where_it_was_taken_over(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        goal = await client_of(connection).send_goal(-3)
        await read_three(goal)
        async with fleet.worker("b").serve(server(recovery="rerun")) as b:
            a.die()
            await anyio.sleep(2)
            b.take_over("count", goal.goal_id)
            await read_three(goal)
            assert (goal.attempt, goal.feedback.dropped) == (2, 0)
            assert (await goal.cancel()).accepted
            assert (await goal.outcome()).status is GoalStatus.CANCELED


async def test_a_goal_that_has_ended_needs_no_worker(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        goal = await client_of(connection).send_goal(-1)
        assert await anext(goal.feedback) == 0
        a.die()
        await anyio.sleep(2)
        a.own(goal.goal_id, **ENDED)
        assert await goal.outcome() == End(GoalStatus.SUCCEEDED, "3")
        assert [item async for item in goal.feedback] == []
        assert goal.feedback.dropped == 2


async def test_a_goal_whose_record_is_gone_is_unknown(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        goal = await client_of(connection).send_goal(-3)
        a.die()
        fleet.broker.store(NAMES.goal("count", goal.goal_id), b"")
        assert (await goal.outcome()).status is GoalStatus.UNKNOWN


async def test_a_goal_whose_record_may_be_written_again_is_waited_for(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        goal = await client_of(connection).send_goal(-3)
        subject = NAMES.goal("count", goal.goal_id)
        record = fleet.broker.shared.records.pop(subject)
        fleet.broker.shared.stream = None
        a.hang_up()
        a.end_lease()
        await anyio.sleep(2)
        fleet.broker.before = away_for("find_stream")
        await anyio.sleep(2)
        fleet.broker.before = nothing
        assert goal.status.is_active
        fleet.broker.shared.records[subject] = record
        a.own(goal.goal_id, **ENDED)
        assert await goal.outcome() == End(GoalStatus.SUCCEEDED, "3")


async def test_a_goal_whose_record_cannot_be_read_fails(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        goal = await client_of(connection).send_goal(-3)
        a.die()
        fleet.broker.store(NAMES.goal("count", goal.goal_id), b"?")
        with pytest.raises(ProtocolError, match="the record of a goal of the fleet cannot be read"):
            await goal.outcome()


async def test_a_goal_that_no_worker_goes_on_with_is_lost_in_time(fleet: FakeFleet) -> None:
    async with (
        fleet.worker("a").serve(server()) as a,
        fleet.connect(reconnect_timeout=20) as connection,
    ):
        goal = await client_of(connection).send_goal(-3)
        began = anyio.current_time()
        a.hang_up()
        async with Running(goal.outcome) as waiting:
            await anyio.sleep(6)
            a.end_lease()
            text = "no worker has gone on with goal .* within 20 s: worker 'a' is gone"
            with pytest.raises(ConnectionLost, match=text):
                await waiting.answer(within=60)
        assert anyio.current_time() - began == pytest.approx(20, abs=0.1)


async def test_a_line_that_flickers_is_dialed_again(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        goal = await client_of(connection).send_goal(-3)
        await read_three(goal)
        gets = fleet.broker.gets
        a.flicker()
        await anyio.sleep(1)
        assert (await goal.cancel()).accepted
        assert (await goal.outcome()).status is GoalStatus.CANCELED
        assert (fleet.lines.dialed, fleet.broker.gets) == (["a", "a"], gets + 1)


async def test_records_are_read_when_the_brokers_are_back(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        goal = await client_of(connection).send_goal(-1)
        fleet.broker.before = away_for("get")
        a.die()
        a.own(goal.goal_id, **ENDED)
        async with Running(goal.outcome) as waiting:
            await anyio.sleep(5)
            fleet.broker.before = nothing
            assert await waiting.answer() == End(GoalStatus.SUCCEEDED, "3")


async def test_a_worker_that_does_not_know_its_goal_yet_is_asked_again(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        goal = await client_of(connection).send_goal(-3)
        await read_three(goal)
        async with fleet.worker("b").serve(server()) as b:
            b.own(goal.goal_id, stamp=goal.stamp)
            a.die()
            async with Running(goal.outcome) as waiting:
                await anyio.sleep(8)
                asked = fleet.broker.gets
                assert asked < 15  # less and less
                b.take_over("count", goal.goal_id)
                assert (await waiting.answer()).status is GoalStatus.SUCCEEDED


async def test_leaving_ends_goals_that_are_lost(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a:
        async with fleet.connect() as connection:
            goal = await client_of(connection).send_goal(-3)
            other = await client_of(connection).send_goal(-3)
            a.die()
            await settled()
            async with fleet.worker("b").serve(server()) as b:
                b.own(other.goal_id, stamp=other.stamp)
        for one in (goal, other):
            with pytest.raises(ConnectionLost):
                await one.outcome()


async def test_connections_that_are_not_used_are_closed(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        client = client_of(connection)
        await client.call(3)
        await anyio.sleep(worker_connections.IDLE / 2)
        await client.call(3)
        assert fleet.lines.dialed == ["a"]
        await anyio.sleep(2.1 * worker_connections.IDLE)
        assert a.lines[0].is_cut
        goal = await client.send_goal(-1)
        await anyio.sleep(3 * worker_connections.IDLE)
        assert fleet.lines.dialed == ["a", "a"]
        await goal.cancel()


async def test_a_goal_whose_record_is_being_read_ends_when_the_client_leaves(
    fleet: FakeFleet,
) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        goal = await client_of(connection).send_goal(-3)
        gate = anyio.Event()

        async def slow(call: str, _subject: str) -> None:
            if call == "get":
                await gate.wait()

        fleet.broker.before = slow
        a.die()
        a.own(goal.goal_id, **ENDED)
        await settled()
        await connection.leave()
        gate.set()
        await settled()
        with pytest.raises(ConnectionLost):
            await goal.outcome()


async def test_without_reconnect_the_next_goal_has_a_new_line(fleet: FakeFleet) -> None:
    async with (
        fleet.worker("a").serve(server()) as a,
        fleet.connect(reconnect=False) as connection,
    ):
        client = client_of(connection)
        assert await client.call(3) == "3"
        a.flicker()
        await settled()
        assert await client.call(3) == "3"
        assert fleet.lines.dialed == ["a", "a"]


# Questions of a client for workers that have room


@asynccontextmanager
async def places_of(fleet: FakeFleet, patience: float = 10) -> AsyncGenerator[RoomFinder, None]:
    async with Background() as tasks:
        workers = FleetWorkers(fleet.broker, NAMES, tasks, 5)
        yield RoomFinder(fleet.broker, NAMES, workers, tasks, patience)


def goals_asked(fleet: FakeFleet) -> list[int]:
    return [question(data).goals for data in fleet.broker.questions]


async def test_goals_that_wait_are_asked_for_together(fleet: FakeFleet) -> None:
    taken: list[str] = []

    async def take() -> None:
        taken.append((await places.take("count")).worker)

    async with fleet.worker("a").serve(server()), places_of(fleet) as places:
        async with anyio.create_task_group() as tasks:
            for _ in range(40):
                tasks.start_soon(take)
        assert taken == ["a"] * 40
        assert goals_asked(fleet) == [40, 24, 8]
        assert (await places.take("count")).worker == "a"
        assert goals_asked(fleet)[3:] == [1]


# Places that goals have left


async def test_quick_goals_one_after_another_need_few_questions(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()), fleet.connect() as connection:
        client = client_of(connection)
        for _ in range(20):
            await client.call(0)
        assert goals_asked(fleet) == [1]
        await anyio.sleep(OFFER_LIFE)
        await client.call(0)
        assert goals_asked(fleet) == [1, 1]


def goal_of(status: GoalStatus = GoalStatus.EXECUTING) -> Any:
    goal = SimpleNamespace(status=status)
    goal.when_ended = lambda callback: setattr(goal, "end", callback)
    return goal


async def test_a_goal_that_waits_gets_the_place_of_one_that_ends(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, places_of(fleet) as places:
        goal = goal_of()
        places.fill("count", await places.take("count"), goal)
        a.is_frozen = True
        async with Running(lambda: places.take("count")) as taking:
            await settled()
            goal.end()
            place = await taking.answer()
        assert (place.worker, place.is_used) == ("a", True)


@pytest.mark.parametrize("change", ["gone", "busy", "old"])
async def test_a_place_that_may_be_taken_is_not_used_again(fleet: FakeFleet, change: str) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        places = connection._parts.places
        await connection.workers()
        place = await places.take("count")
        for _ in range(3):
            places.fill("count", place, goal_of(GoalStatus.SUCCEEDED))
        assert (await places.take("count")).is_used
        async with fleet.worker("b").serve(server()):
            if change == "gone":
                a.die()
            elif change == "old":
                await anyio.sleep(OFFER_LIFE)
            else:
                places.refuse("count", place)
                a.deafen()
            await settled()
            taken = await places.take("count")
            assert not taken.is_used
            places.refuse("other", taken)


async def test_room_in_a_queue_is_not_used_again(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, places_of(fleet) as places:
        a.deafen()
        a.listen(NAMES.queue("count"))
        places.fill("count", await places.take("count"), goal_of(GoalStatus.SUCCEEDED))
        assert not (await places.take("count")).is_used


async def test_a_worker_that_has_no_room_any_more_is_followed_by_a_question(
    fleet: FakeFleet,
) -> None:
    async with (
        fleet.worker("a").serve(server(max_goals=1)) as a,
        fleet.connect() as connection,
        fleet.connect() as other,
    ):
        await client_of(connection).call(0)
        await client_of(other).send_goal(-1)
        async with fleet.worker("b").serve(server()):
            a.deafen()
            await settled()
            began = anyio.current_time()
            assert await client_of(connection).call(3) == "3"
            assert anyio.current_time() == pytest.approx(began, abs=0.01)
        assert goals_asked(fleet) == [1, 1, 1]


async def test_a_goal_that_waits_no_longer_needs_no_place(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, places_of(fleet) as places:
        a.is_frozen = True
        with anyio.move_on_after(0.1):
            await places.take("count")
        async with Running(lambda: places.take("count")) as taking:
            a.is_frozen = False
            assert (await taking.answer()).worker == "a"
        assert goals_asked(fleet)[-1] == 1


async def test_a_worker_that_does_not_answer_is_left_for_another_soon(fleet: FakeFleet) -> None:
    async with fleet.serving("a", "b") as (a, _), places_of(fleet) as places:
        a.is_frozen = True
        began = anyio.current_time()
        assert (await places.take("count")).worker == "b"
        assert anyio.current_time() - began == pytest.approx(FIRST_WAIT, abs=0.01)


async def test_workers_that_do_not_answer_are_asked_less_and_less(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, places_of(fleet) as places:
        a.is_frozen = True
        text = "no worker of action 'count' has answered within 10 s: no answer"
        with pytest.raises(ConnectionLost, match=text):
            await places.take("count")
        assert len(a.asked) == 8


async def test_an_answer_that_cannot_be_read_is_like_none(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()), places_of(fleet) as places:
        fleet.broker.listen(NAMES.offer("count"), lambda data: b"?")
        for _ in range(2):
            assert (await places.take("count")).worker == "a"


async def test_workers_with_room_in_their_queue_are_asked_last(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, places_of(fleet) as places:
        fleet.broker.listen(NAMES.queue("count"), lambda data: encode(RoomOffer("queue", 1)))
        assert (await places.take("count")).worker == "a"
        a.deafen()
        assert (await places.take("count")).worker == "queue"


async def test_busy_workers_are_told_apart_from_none(fleet: FakeFleet) -> None:
    async with places_of(fleet) as places:
        with pytest.raises(ServerNotFound, match="is not served in this fleet: there is nothing"):
            await places.take("count")
        async with fleet.worker("a").serve(server()) as a, fleet.worker("b").serve(server()) as b:
            for worker in (a, b):
                worker.deafen()
                worker.has_room = False
                worker.renew()
            await settled()
            with pytest.raises(GoalRejected) as caught:
                await places.take("count")
            assert caught.value.reason == "busy: all 2 workers of action 'count' are busy"
            b.die()
            await settled()
            assert (await places.take("count")).worker == "a"  # the only one answers itself


@pytest.mark.parametrize(("is_back", "wait"), [(False, ROOM_WAIT), (True, RETURN_WAIT)])
async def test_a_worker_that_has_room_by_its_lease_is_waited_for_longer_after_a_reconnection(
    fleet: FakeFleet, is_back: bool, wait: float
) -> None:
    async with fleet.serving("a", "b") as (a, b), places_of(fleet) as places:
        a.deafen()
        b.deafen()

        def begin() -> None:
            fleet.broker.reconnected_at = anyio.current_time() if is_back else -math.inf

        begin()
        began = anyio.current_time()
        with pytest.raises(GoalRejected, match="busy"):
            await places.take("count")
        assert anyio.current_time() - began == pytest.approx(wait, abs=0.1)
        begin()
        async with Running(lambda: places.take("count")) as taking:
            await anyio.sleep(wait / 2)
            a.listen(NAMES.offer("count"))
            assert (await taking.answer()).worker == "a"


# The workers of a fleet, as a client knows them from their leases


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
    async with fleet.serving("a", "b") as (_, b), workers_of(fleet) as (workers, gone):
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

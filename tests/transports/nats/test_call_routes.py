"""Goals that are lost at one worker, and go on at another, or end by their record."""

from __future__ import annotations

import anyio
import pytest

from fibaction import (
    ClientGoal,
    ConnectionLost,
    GoalStatus,
    ProtocolError,
)
from fibaction_transports.nats.broker.broker import BrokerAway
from fibaction_transports.nats.client import worker_connections
from tests.support.matching import End
from tests.support.memory_broker import Before, nothing
from tests.support.virtual_time import in_virtual_time
from tests.transports.nats.fake_fleet import (
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

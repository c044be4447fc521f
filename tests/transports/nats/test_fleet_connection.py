"""What a client is told of a fleet as a whole."""

from __future__ import annotations

import pytest

from fibaction import ActionPeers, ConnectionLost, ServerNotFound, StoreError
from tests.support.virtual_time import in_virtual_time
from tests.transports.nats.fake_fleet import (
    COUNT,
    ENDED,
    GOAL_ID,
    THREE,
    FakeFleet,
    client_of,
    server,
)

pytestmark = [pytest.mark.anyio, in_virtual_time()]


@pytest.fixture
def fleet() -> FakeFleet:
    return FakeFleet()


async def test_actions_workers_and_peers_are_those_of_all_workers(fleet: FakeFleet) -> None:
    async with (
        fleet.worker("a").serve(server()),
        fleet.worker("b").serve(server()),
        fleet.connect() as connection,
    ):
        assert await connection.actions() == [COUNT.info]
        assert [worker.name for worker in await connection.workers()] == ["a", "b"]
        assert connection.endpoint(COUNT.info).info == COUNT.info
        await client_of(connection).call(3)
        assert await connection.peers("count") == ActionPeers(("a", "b"), ("client",))
        with pytest.raises(ServerNotFound):
            await connection.peers("fly")


async def test_goals_that_were_given_up_are_those_of_the_fleet(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        a.own(GOAL_ID, **{**ENDED, "goal": THREE})
        (goal,) = (await connection.given_up())["count"]
        assert goal.goal_id == GOAL_ID
        with pytest.raises(StoreError, match="was not given up"):
            await connection.rerun("fly", GOAL_ID)


async def test_a_connection_that_was_left_is_of_no_use(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()):
        async with fleet.connect() as connection:
            client = client_of(connection)
            await client.call(3)
        for ask in (
            lambda: client.call(3),
            connection.actions,
            connection.workers,
            client.goals,
            client.cancel_goals,
            lambda: client.wait_for_server(),
        ):
            with pytest.raises(ConnectionLost, match="was closed here"):
                await ask()

"""What a client is told of a fleet as a whole."""

from __future__ import annotations

import pytest

from fibaction import ActionPeers, ConnectionLost, ServerNotFound
from tests.support.virtual_time import in_virtual_time
from tests.transports.nats.fake_fleet import COUNT, FakeFleet, client_of, server

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

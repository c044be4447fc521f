"""A fleet whose broker has little storage, which the goals of one client fill."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Generator

import anyio
import msgspec
import pytest

from fibaction import (
    Action,
    ActionServer,
    ClientGoal,
    GoalHandle,
    GoalRejected,
    GoalStatus,
    connect,
    serve,
)
from tests.support.nats_server import IS_LEFT_OUT, NatsServer, nats_server

pytestmark = pytest.mark.asyncio


class Load(msgspec.Struct):
    weight: bytes = b""


CARRY = Action("carry", goal=Load, feedback=str, result=int)
LARGE = Load(bytes(300_000))


@pytest.fixture
def broker() -> Generator[NatsServer, None, None]:
    if IS_LEFT_OUT:
        pytest.skip("nats-server is not installed: see the extra `broker`")
    with nats_server("jetstream: {max_file_store: 16MB}") as server:
        yield server


@pytest.mark.promise("FLEET-9")
async def test_a_client_that_fills_the_broker_is_told_busy_and_harms_no_goal(
    broker: NatsServer,
) -> None:
    go = anyio.Event()

    async def carry(goal: GoalHandle[Load]) -> AsyncGenerator[str | int, None]:
        if goal.request.weight:
            await go.wait()
        yield len(goal.request.weight)

    with anyio.fail_after(120):
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

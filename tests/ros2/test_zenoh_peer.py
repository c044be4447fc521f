"""What is asked of `zenoh://` with real nodes of `rmw_zenoh_cpp`, beside the tests of stock ends.

They run where FIBACTION_ZENOH_PEER says that such nodes are (`zenoh_peer`), and not in the check.
"""

from __future__ import annotations

import os
from collections.abc import AsyncGenerator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from time import perf_counter
from typing import Any, TypeAlias

import anyio
import pytest

from fibaction import (
    ActionClient,
    ActionServer,
    ConnectionLost,
    GoalStatus,
    connect,
    serve,
)
from tests.ros2.stock import orders
from tests.ros2.stock.ours import Behaviour, action
from tests.ros2.stock.process import Peer, peer
from tests.ros2.test_two_middlewares import Text, echo, execute_echo
from tests.ros2.zenoh_peer import middleware, router_for
from tests.support.fibonacci import Feedback, Goal, Result
from tests.support.ports import free_port
from tests.support.zenoh_router import start_router

Client: TypeAlias = ActionClient[Goal, Feedback, Result]

WHERE = "zenoh:///ours"
FILES = Path(__file__).parents[2] / "examples/ros2"
PATIENCE = 60.0
MANY = int(os.environ.get("FIBACTION_ZENOH_GOALS", "300"))
"""Goals one by one: 10,000 show the longest pause of released servers."""
SECONDS = float(os.environ.get("FIBACTION_ZENOH_SECONDS", "5"))
"""Seconds in which participants come and go."""
pytestmark = [pytest.mark.anyio, pytest.mark.timeout(PATIENCE + SECONDS + MANY / 20)]

RATED = 2_000
SUCCEEDED = int(GoalStatus.SUCCEEDED)
EXECUTING = int(GoalStatus.EXECUTING)


@pytest.fixture(autouse=True, scope="module")
def router() -> Iterator[None]:
    with router_for("zenoh"):
        yield


@asynccontextmanager
async def stock_server() -> AsyncGenerator[tuple[Peer, Client], None]:
    """Run a stock server, and give a client of it."""
    with anyio.fail_after(PATIENCE):
        async with (
            peer("server", **middleware("zenoh")) as found,
            connect(WHERE, action("stock")) as client,
        ):
            await client.wait_for_server(20)
            yield found, client


@asynccontextmanager
async def stock_client(**settings: Any) -> AsyncGenerator[Peer, None]:
    """Serve, and give a stock client of the server."""
    with anyio.fail_after(PATIENCE):
        async with (
            serve(Behaviour().server("ours", **settings), WHERE),
            peer("client", **middleware("zenoh")) as found,
        ):
            assert await found.ask("ready", action="ours")
            yield found


async def test_goals_one_by_one_have_no_long_pause_although_the_server_forgets_to_wake_up() -> None:
    pauses: list[float] = []
    with anyio.fail_after(PATIENCE + MANY / 20):
        async with (
            peer("server", **middleware("zenoh")),
            connect(WHERE, action("stock")) as client,
        ):
            await client.wait_for_server(20)
            for _ in range(MANY):
                began = perf_counter()
                assert await client.call(Goal(1)) == Result([0, 1])
                pauses.append(perf_counter() - began)
    pauses.sort()
    print(f"{MANY} goals: median {pauses[MANY // 2] * 1e3:.1f} ms, most {pauses[-1] * 1e3:.0f} ms")
    assert pauses[-1] < 2.0  # a stock client waits ten seconds now and then


async def test_the_death_of_a_stock_server_is_known_at_once() -> None:
    async with stock_server() as (server, client):
        goal = await client.send_goal(Goal(orders.WAITS))
        assert await anext(goal.feedback) == Feedback([1])
        server.process.kill()
        began = perf_counter()
        with pytest.raises(ConnectionLost, match="the server of 'stock' has gone away"):
            await goal.result()
        print(f"known after {(perf_counter() - began) * 1e3:.0f} ms")
        assert perf_counter() - began < 2.0  # 0.06 to 0.08 s on a machine that does nothing else


@pytest.mark.parametrize("size", [1_000_000, 8_000_000])
async def test_large_goals_and_results_go_both_ways(size: int) -> None:
    text = "o" * size
    with anyio.fail_after(PATIENCE):
        async with (
            serve(ActionServer(echo("ours_large"), execute_echo), WHERE),
            peer("echo", "client", "ours_large", **middleware("zenoh")) as stock,
            peer("echo", "server", "large", **middleware("zenoh")),
            connect(WHERE, echo("large")) as client,
        ):
            assert (await client.call(Text(text))).text == text
            answer = await stock.ask("call", text=text)
            assert (answer["status"], answer["is_same"]) == (SUCCEEDED, True)


async def test_goals_run_on_while_the_router_is_away_and_when_it_is_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    port = free_port()
    monkeypatch.setenv("ZENOH_CONFIG_OVERRIDE", f'connect/endpoints=["tcp/127.0.0.1:{port}"]')
    router = start_router(port)
    try:
        async with stock_server() as (_, client), stock_client() as stock:
            goal = await client.send_goal(Goal(orders.RATED + 600))
            sent = await stock.ask("send", action="ours", order=orders.RATED + 600)
            assert await anext(goal.feedback) == Feedback([0])
            await anyio.to_thread.run_sync(router.close)
            assert await client.call(Goal(2)) == Result([0, 1, 1])
            router = start_router(port)
            assert len([one async for one in goal.feedback]) == 599
            assert await goal.result() == Result([])
            assert (await stock.ask("result", goal=sent["goal"]))["status"] == SUCCEEDED
            assert await client.call(Goal(2)) == Result([0, 1, 1])
    finally:
        await anyio.to_thread.run_sync(router.close)


async def test_participants_that_come_and_go_disturb_nobody() -> None:
    deadline = anyio.current_time() + SECONDS
    calls = 0

    async def use(client: Client) -> None:
        nonlocal calls
        while anyio.current_time() < deadline:
            assert await client.call(Goal(2)) == Result([0, 1, 1])
            calls += 1

    async def come_and_go() -> None:
        while anyio.current_time() < deadline:
            async with connect(WHERE, action("stock")) as client:
                await client.wait_for_server(20)
                assert await client.call(Goal(3)) == Result([0, 1, 1, 2])

    async def stock_comes_and_goes() -> None:
        while anyio.current_time() < deadline:
            async with peer("client", **middleware("zenoh")) as other:
                sent = await other.ask("send", action="ours", order=3)
                result = await other.ask("result", goal=sent["goal"])
                assert result["sequence"] == [0, 1, 1, 2]
                other.process.kill()

    with anyio.fail_after(PATIENCE + SECONDS):
        async with (
            serve(Behaviour().server("ours"), WHERE),
            peer("server", **middleware("zenoh")),
            connect(WHERE, action("stock")) as client,
        ):
            await client.wait_for_server(20)
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(use, client)
                tasks.start_soon(come_and_go)
                tasks.start_soon(stock_comes_and_goes)
    print(f"{calls} goals in {SECONDS:.0f} s")
    assert calls

"""A fleet whose action is paused, and one of whose workers drains, with a broker of NATS."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import anyio
import pytest

from fibaction import (
    Action,
    ActionServer,
    GoalHandle,
    GoalRejected,
    RejectionCode,
    ServerNotFound,
    TransportError,
    connect,
    serve,
)
from fibaction.words.intake import IntakeChange, IntakeMode
from tests.support.nats_server import NatsServer

pytestmark = [pytest.mark.anyio]
MOVE = Action("move", goal=str, feedback=int, result=str)
REFUSE = IntakeChange(IntakeMode.REFUSE, "wet floor", "ann")
HOLD, OPEN = IntakeChange(IntakeMode.HOLD), IntakeChange(IntakeMode.OPEN)


@asynccontextmanager
async def workers(url: str, *names: str) -> AsyncGenerator[None, None]:
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
            async with workers(url, "a", "b"):
                await client.wait_for_server()
                assert (await client.endpoint.intake()).mode is IntakeMode.OPEN
                intake = await client.endpoint.change_intake(REFUSE)
                assert len(intake.changes) == 1
                async with workers(url, "c"):
                    for _ in range(6):
                        with pytest.raises(GoalRejected, match="wet floor") as rejected:
                            await client.send_goal("x")
                        assert rejected.value.code is RejectionCode.BUSY
            async with workers(url, "d"):  # all others have gone
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
        async with workers(url, "a", "b"), connect(url, MOVE) as client:
            endpoint = client.endpoint
            assert (await endpoint.change_intake(drain)).mode is IntakeMode.DRAIN
            assert (await endpoint.intake()).mode is IntakeMode.OPEN
            assert {await client.call("x") for _ in range(8)} == {"b"}
            with pytest.raises(ServerNotFound, match="no worker 'z' serves 'move'"):
                await endpoint.change_intake(IntakeChange(IntakeMode.DRAIN, worker="z"))
            with pytest.raises(TransportError, match="about all workers"):
                await endpoint.change_intake(IntakeChange(IntakeMode.HOLD, worker="a"))
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

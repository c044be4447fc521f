"""The start and the stop of a server: `fibaction.server.parts`, and the life of `ActionServer`."""

from __future__ import annotations

import asyncio  # noqa: TID251  # it alone can cancel a task without a scope
import math
from types import SimpleNamespace
from typing import Any, cast

import anyio
import pytest

from fibaction import (
    ActionServer,
    GoalHandle,
    GoalID,
    GoalStatus,
    ServerNotFound,
)
from fibaction.border.abc import GoalStream
from fibaction.server.execution.interruption import CancelOnce
from fibaction.server.execution.runs import Runs
from fibaction.server.execution.turns import Turns
from fibaction.words.errors import GoalKept
from tests.server.held import Held, packed, start_many, turns_during
from tests.support.executors import Items
from tests.support.fibonacci import FIBONACCI, Goal, Result, fibonacci
from tests.support.matching import End
from tests.support.memory_store import MemoryStore
from tests.support.slices import let_slices_last

pytestmark = pytest.mark.anyio


# Starting and stopping


@pytest.mark.promise("STOP-8")
async def test_a_server_that_is_not_running_is_not_found() -> None:
    server = ActionServer(FIBONACCI, fibonacci)
    goal_id = GoalID.random()
    assert server.is_new
    assert repr(server) == "<ActionServer 'fibonacci' new goals=0>"
    with pytest.raises(ServerNotFound, match="'fibonacci' is not running"):
        await server.send_goal(goal_id, packed(1))
    async with server:
        assert not server.is_new
        assert server.is_running
        assert server.info is FIBONACCI.info
        await server.wait_for_server()
    for call in (
        server.send_goal(goal_id, packed(1)),
        server.feedback(goal_id),
        server.cancel_goals(),
        server.status(),
        server.wait_for_server(),
        server.get_result(goal_id),
    ):
        with pytest.raises(ServerNotFound, match="'fibonacci' is not running"):
            await call
    with pytest.raises(RuntimeError, match="was started before; make another one"):
        await server.__aenter__()


@pytest.mark.promise("ERROR-3")
async def test_the_exception_of_the_block_goes_on_as_itself() -> None:
    error = KeyError("mine")
    with pytest.raises(KeyError) as caught:
        async with ActionServer(FIBONACCI, fibonacci):
            raise error
    assert caught.value is error


@pytest.mark.promise("STOP-10")
async def test_a_server_whose_block_is_canceled_stops_as_any_other() -> None:
    begun, cleaned = anyio.Event(), []

    async def tidies_up(goal: GoalHandle[Goal]) -> Items:
        begun.set()
        try:
            await anyio.sleep_forever()
        finally:
            await anyio.lowlevel.checkpoint()
            cleaned.append(goal.request.order)
        yield Result([])

    with anyio.CancelScope() as scope:
        async with ActionServer(FIBONACCI, tidies_up) as server:
            stream = await server.send_goal(GoalID.random(), packed(7))
            await begun.wait()
            scope.cancel()
            await anyio.sleep_forever()
    assert scope.cancelled_caught
    assert cleaned == [7]
    assert await stream.outcome() == End(GoalStatus.ABORTED, None, "server stopped")


class Tidying:
    """An executor whose clean-up waits until it is let go."""

    def __init__(self) -> None:
        self.begun, self.cleaning, self.go = anyio.Event(), anyio.Event(), anyio.Event()
        self.is_clean = False

    async def __call__(self, goal: GoalHandle[Goal]) -> Items:
        try:
            self.begun.set()
            await anyio.sleep_forever()
        finally:
            self.cleaning.set()
            await self.go.wait()
            self.is_clean = True
        yield Result([])


@pytest.mark.promise("STOP-10")
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_a_server_whose_task_is_itself_canceled_again_and_again_stops_as_any_other() -> None:
    executor = Tidying()
    server = ActionServer(FIBONACCI, executor, shutdown_timeout=math.inf)

    async def serves() -> None:
        async with server:
            await anyio.sleep_forever()

    before = asyncio.all_tasks()
    with anyio.fail_after(5):
        task = asyncio.create_task(serves())
        await server.wait_for_server()
        stream = await server.send_goal(GoalID.random(), packed(1))
        await executor.begun.wait()
        for _ in range(3):
            task.cancel()
            await executor.cleaning.wait()
            await anyio.wait_all_tasks_blocked()
        assert not task.done()
        executor.go.set()
        await asyncio.wait([task])
        assert task.cancelled()
        assert await stream.outcome() == End(GoalStatus.ABORTED, None, "server stopped")
    assert executor.is_clean
    assert asyncio.all_tasks() == before


@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_a_stop_that_is_canceled_while_it_waits_for_the_store_ends_all_executors() -> None:
    store, executor = MemoryStore(), Tidying()
    async with ActionServer(FIBONACCI, executor, store=store, shutdown_timeout=0.5) as server:
        with anyio.fail_after(5):
            await server.send_goal(GoalID.random(), packed(1))
            await executor.begun.wait()
            store.hold()
            sending = asyncio.create_task(server.send_goal(GoalID.random(), packed(2)))
            stopping = asyncio.create_task(server.stop())
            while server.is_running:
                await anyio.lowlevel.checkpoint()
            stopping.cancel()
            await asyncio.wait([stopping, sending])
            assert stopping.cancelled()
            assert isinstance(sending.exception(), GoalKept)
            assert executor.cleaning.is_set()
            store.release()


async def test_only_a_coroutine_that_runs_is_given_up() -> None:
    scopes = CancelOnce(lambda: None, Turns())
    scopes.abandon()
    given_up: list[str] = []
    scopes.steps = cast("Any", SimpleNamespace(abandon=lambda: given_up.append("it")))
    scopes.abandon()
    assert given_up == ["it"]


@pytest.mark.promise("EXECUTE-10")
async def test_ctrl_c_in_an_executor_ends_its_goal_and_the_program(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def exits(goal: GoalHandle[Goal]) -> Items:
        raise KeyboardInterrupt
        yield Result([])

    server = ActionServer(FIBONACCI, exits)
    streams: list[GoalStream] = []

    # asyncio ends its loop at once on a KeyboardInterrupt, so that the wire is cut on trio only;
    # here the executor is run by hand, and both must let it through.
    run_goal = Runs._run

    async def run_and_catch(runs: Any, run: Any, scopes: CancelOnce) -> None:
        with pytest.raises(KeyboardInterrupt):
            await run_goal(runs, run, scopes)
        scope.cancel()

    monkeypatch.setattr(Runs, "_run", run_and_catch)
    with anyio.CancelScope() as scope:
        async with server:
            streams.append(await server.send_goal(GoalID.random(), packed(1)))
            await anyio.sleep_forever()
    assert await streams[0].outcome() == End(GoalStatus.ABORTED, None, "KeyboardInterrupt")


class Stubborn:
    """An executor whose clean-up does not end by itself."""

    async def __call__(self, goal: GoalHandle[Goal]) -> Items:
        try:
            await anyio.sleep_forever()
        finally:
            await anyio.sleep_forever()
        yield Result([])


# Stopping with many goals


@pytest.fixture
def no_slice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every slice is over at once."""
    let_slices_last(monkeypatch, -1.0)


@pytest.mark.usefixtures("no_slice")
@pytest.mark.parametrize("executor", [Held, Stubborn], ids=["in time", "not in time"])
async def test_a_stop_gives_others_their_turns_and_names_some_goals_only(
    executor: Any, caplog: pytest.LogCaptureFixture
) -> None:
    async with ActionServer(FIBONACCI, executor(), shutdown_timeout=0) as server:
        streams = await start_many(server, 30)
        assert await turns_during(server.stop()) > 20
        reasons = {(await stream.outcome()).reason for stream in streams}
    assert reasons == {"server stopped"}
    if executor is Stubborn:
        assert caplog.text.count("and is killed") == 10
        assert "20 more goals of action 'fibonacci' did not stop in time either" in caplog.text


@pytest.mark.usefixtures("no_slice")
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_a_stop_that_is_itself_canceled_while_it_kills_ends_every_goal() -> None:
    async with ActionServer(FIBONACCI, Stubborn(), shutdown_timeout=0) as server:
        with anyio.fail_after(5):
            streams = await start_many(server, 30)
            task = asyncio.create_task(server.stop())
            while not any(stream.status.is_terminal for stream in streams):
                await anyio.lowlevel.checkpoint()
            task.cancel()
            await asyncio.wait([task])
            assert task.cancelled()
            reasons = {(await stream.outcome()).reason for stream in streams}
    assert reasons == {"server stopped"}

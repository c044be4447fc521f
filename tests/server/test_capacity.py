"""The room for goals that a server tells its store, and its drain."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator
from functools import partial
from typing import Any, TypeAlias

import anyio
import pytest
from anyio import current_time

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalHandle,
    GoalRejected,
    GoalStatus,
    Schedule,
)
from tests.support.memory_store import MemoryStore
from tests.support.virtual_time import in_virtual_time

pytestmark = [pytest.mark.anyio, in_virtual_time()]

WORK = Action("work", goal=float, feedback=bytes, result=str)
Working: TypeAlias = AsyncGenerator[bytes | str, None]
DRAINS = "busy: the server drains"


async def work(goal: GoalHandle[float]) -> Working:
    """Work so many seconds."""
    await anyio.sleep(goal.request)
    yield "done"


def server_with(store: MemoryStore | None, **settings: Any) -> ActionServer[float, bytes, str]:
    return ActionServer(WORK, work, store=store, **settings)


def client_of(server: ActionServer[float, bytes, str]) -> ActionClient[float, bytes, str]:
    return ActionClient(server, WORK)


# Room


async def test_a_server_without_a_schedule_has_room_until_it_has_as_many_goals_as_it_may() -> None:
    store = MemoryStore()
    async with server_with(store, max_goals=2) as server:
        assert store.rooms == [(math.inf, 0)]
        client = client_of(server)
        goals = [await client.send_goal(seconds) for seconds in (1, 2)]
        assert store.rooms == [(math.inf, 0), (0, 0)]
        with pytest.raises(GoalRejected, match="busy: 2 goals are active, the limit is 2"):
            await client.send_goal(1)
        for goal in goals:
            await goal.result()
        assert store.rooms == [(math.inf, 0), (0, 0), (math.inf, 0)]
    assert store.rooms[3:] == [(0, 0)]


async def test_a_schedule_has_room_to_run_and_to_wait() -> None:
    store = MemoryStore()
    async with server_with(store, schedule=Schedule(concurrency=2, queue=1)) as server:
        client = client_of(server)
        goals = [await client.send_goal(seconds) for seconds in (1, 2, 3)]
        assert store.rooms == [(2, 1), (0, 1), (0, 0)]
        store.rooms.clear()
        for goal in goals:
            await goal.result()
        assert store.rooms == [(0, 1), (1, 1)]


async def test_a_server_with_too_many_bytes_has_no_room_until_their_goal_has_ended() -> None:
    async def talk(goal: GoalHandle[float]) -> Working:
        yield bytes(1000)
        await anyio.sleep(goal.request)
        yield "done"

    store = MemoryStore()
    async with ActionServer(
        WORK, talk, store=store, max_bytes=500, interrupt_on_cancel=False
    ) as server:
        goal = await client_of(server).send_goal(10)
        await anyio.sleep(1)
        await goal.cancel()
        assert store.rooms == [(math.inf, 0), (0, 0)]
        with pytest.raises(GoalRejected, match="busy: goals and feedback would take"):
            await client_of(server).send_goal(1)
        await anyio.sleep(30)  # until the feedback counts as not read, and the executor has slept
        assert store.rooms == [(math.inf, 0), (0, 0), (math.inf, 0)]


# Drain


@pytest.mark.parametrize("store", [None, MemoryStore()], ids=["alone", "store"])
async def test_a_server_that_drains_rejects_new_goals_and_waits_for_the_others(store: Any) -> None:
    async with server_with(store) as server:
        client = client_of(server)
        goals = [await client.send_goal(seconds) for seconds in (1, 3)]
        async with anyio.create_task_group() as tasks:
            begin = current_time()
            tasks.start_soon(server.drain)
            await anyio.sleep(0.5)
            with pytest.raises(GoalRejected, match=DRAINS) as caught:
                await client.send_goal(1)
            assert caught.value.is_busy
            same = await client.send_goal(1, goal_id=goals[0].goal_id)  # it is known
            assert await same.result() == "done"
        assert current_time() - begin == pytest.approx(3, abs=0.5)
        assert (await goals[1].outcome()).status is GoalStatus.SUCCEEDED
        with pytest.raises(GoalRejected, match=DRAINS):
            await client.send_goal(1)
    if store is not None:
        assert store.rooms == [(math.inf, 0), (0, 0)]


@pytest.mark.parametrize("store", [None, MemoryStore()], ids=["alone", "store"])
@pytest.mark.parametrize("is_step", [True, False])
async def test_what_an_active_goal_sends_is_accepted_during_a_drain(
    store: Any, is_step: bool
) -> None:
    async def mission(goal: GoalHandle[float]) -> Working:
        await anyio.sleep(goal.request)
        if goal.request > 1:  # the drain has begun
            near, far = (goal.step(name) if is_step else None for name in ("near", "far"))
            await client_of(mine).call(0.5, step=near)
            await client_of(other).call(1, step=far)
        yield "done"

    mine, apart = ActionServer(WORK, mission, store=store), ActionServer(WORK, mission)
    async with mine, apart, server_with(None) as other:
        goal, strange = [await client_of(server).send_goal(2) for server in (mine, apart)]
        async with anyio.create_task_group() as tasks:
            for server in (mine, other):
                tasks.start_soon(partial(server.drain, together=(mine, other)))
            await anyio.sleep(1)
            with pytest.raises(GoalRejected, match=DRAINS):
                await client_of(other).send_goal(1)
        assert await goal.result() == "done"
        assert DRAINS in (await strange.outcome()).reason


async def test_a_drain_takes_as_long_as_it_may() -> None:
    async with server_with(None) as server:
        goal = await client_of(server).send_goal(100)
        begin = current_time()
        await server.drain(timeout=5)
        with anyio.move_on_after(5):
            await server.drain()
        assert current_time() - begin == pytest.approx(10, abs=0.5)
        await server.stop()
        await server.drain()
        assert (await goal.outcome()).reason == "server stopped"

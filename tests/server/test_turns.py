"""`fibaction.server.execution.turns`: one executor that does not wait in each turn of the event
loop."""

from __future__ import annotations

from typing import Any

import anyio
import pytest

from fibaction.server.execution.turns import Turns

pytestmark = pytest.mark.anyio


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


async def test_one_goes_on_in_each_turn_and_keys_take_turns() -> None:
    turns = Turns()
    seen: list[str] = []

    async def runs(key: str) -> None:
        while len(seen) < 60:
            await turns.pause(key)
            seen.append(key)

    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            for _ in range(20):
                tasks.start_soon(runs, "many")
            tasks.start_soon(runs, "few")
            most = before = 0
            while len(seen) < 60:
                await anyio.lowlevel.checkpoint()
                most = max(most, len(seen) - before)
                before = len(seen)
    assert most <= 2  # trio, which draws the order of tasks, may let two turns follow each other
    assert 20 <= seen[:60].count("few") <= 31


async def test_one_that_is_alone_goes_on_in_the_next_turn() -> None:
    turns = Turns()
    with anyio.fail_after(5):
        for _ in range(3):
            await turns.pause("a")


async def test_those_that_are_canceled_keep_no_other_waiting() -> None:
    turns = Turns()
    went_on: list[str] = []

    async def runs(key: str, scope: anyio.CancelScope) -> None:
        with scope:
            await turns.pause(key)
            went_on.append(key)

    scopes = {key: anyio.CancelScope() for key in "abcd"}
    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            turns._is_passing = True
            for key, scope in scopes.items():
                tasks.start_soon(runs, key, scope)
                await anyio.wait_all_tasks_blocked()
            scopes["a"].cancel()
            scopes["c"].cancel()
            await anyio.wait_all_tasks_blocked()
            turns._pass_on()
        assert went_on == ["b", "d"]
        await turns.pause("a")
    assert not turns._gone

"""The virtual clock: nobody waits for it, and it says why nothing happens any more."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

import anyio
import pytest

from tests.simulation import loop as virtual


def in_virtual_time(main: Callable[[], Awaitable[Any]], **settings: Any) -> virtual.VirtualLoop:
    loop = virtual.VirtualLoop(**settings)
    virtual.run(main, loop)
    return loop


def test_an_hour_passes_at_once() -> None:
    async def main() -> None:
        begun = anyio.current_time()
        async with anyio.create_task_group() as tasks:
            for _ in range(3):
                tasks.start_soon(anyio.sleep, 3600)
        assert 3600 <= anyio.current_time() - begun < 3601

    assert in_virtual_time(main).turns < 100


def test_if_nobody_can_ever_run_the_loop_says_who_waits() -> None:
    async def waits_in_vain() -> None:
        await anyio.Event().wait()

    with pytest.raises(virtual.Deadlock, match="waits_in_vain"):
        in_virtual_time(waits_in_vain)


def test_a_loop_that_only_turns_is_stopped() -> None:
    async def turns() -> None:
        while True:
            await anyio.lowlevel.checkpoint()

    with pytest.raises(virtual.Livelock):
        in_virtual_time(turns, most_turns=1000)


def test_a_loop_that_only_sleeps_is_stopped() -> None:
    async def sleeps() -> None:
        for _ in range(3600):
            await anyio.sleep(60)

    with pytest.raises(virtual.Livelock):
        in_virtual_time(sleeps, longest=3600)

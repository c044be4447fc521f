"""The virtual clock: nobody waits for it, and it says why nothing happens any more."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

import anyio
import pytest

from tests.simulation import loop as virtual


def test_if_nobody_can_ever_run_the_loop_says_who_waits() -> None:
    async def waits_in_vain() -> None:
        await anyio.Event().wait()

    with pytest.raises(virtual.Deadlock, match="waits_in_vain"):
        virtual.run(waits_in_vain)


async def turns() -> None:
    while True:
        await anyio.lowlevel.checkpoint()


async def sleeps() -> None:
    while True:  # noqa: ASYNC110  # it waits for nothing
        await anyio.sleep(60)


@pytest.mark.parametrize(("main", "limit"), [(turns, "most_turns"), (sleeps, "longest")])
def test_a_loop_that_only_turns_or_sleeps_is_stopped(
    main: Callable[[], Awaitable[None]], limit: str
) -> None:
    limits: Any = {limit: 1000}
    with pytest.raises(virtual.Livelock):
        virtual.run(main, virtual.VirtualLoop(**limits))

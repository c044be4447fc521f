from __future__ import annotations

import gc
from threading import current_thread, main_thread

import anyio
import anyio.from_thread
import pytest
from anyio.lowlevel import checkpoint

from fibaction.schema.turns import SMALL, Pause, in_turn

pytestmark = pytest.mark.anyio


def is_main(pause: Pause | None) -> bool:
    return current_thread() is main_thread()


async def test_a_small_document_is_read_at_once_and_a_large_one_in_a_thread() -> None:
    assert await in_turn(SMALL, is_main)
    assert not await in_turn(SMALL + 1, is_main)
    assert not await in_turn(None, is_main)


async def test_an_error_of_the_work_is_raised() -> None:
    def fail(pause: Pause | None) -> None:
        raise ValueError("wrong")

    for size in (1, None):
        with pytest.raises(ValueError, match="wrong"):
            await in_turn(size, fail)


async def test_the_loop_goes_on_while_a_large_document_is_read() -> None:
    count = 0

    async def turn() -> None:
        nonlocal count
        await checkpoint()
        count += 1

    def work(pause: Pause | None) -> None:
        assert pause is not None
        for _ in range(100):
            pause()
            anyio.from_thread.run(turn)

    await in_turn(None, work)
    assert count == 100


async def test_one_large_document_is_read_at_a_time_in_the_order_of_their_coming() -> None:
    at_work: list[int] = []
    read: list[int] = []

    def work(number: int) -> None:
        at_work.append(number)
        anyio.from_thread.run(checkpoint)
        assert at_work == [number]
        at_work.remove(number)
        read.append(number)

    async def one(number: int) -> None:
        await in_turn(None, lambda pause: work(number))

    async with anyio.create_task_group() as tasks:
        for number in range(5):
            tasks.start_soon(one, number)
            await checkpoint()
    assert sorted(read) == list(range(5))


async def test_the_collector_pauses_while_a_large_document_is_read() -> None:
    def is_collecting(pause: Pause | None) -> bool:
        return gc.isenabled()

    assert await in_turn(1, is_collecting)
    assert not await in_turn(None, is_collecting)
    assert gc.isenabled()

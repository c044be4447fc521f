"""`KeptBlock`: a block that one task holds, and that any may close."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import anyio
import pytest
from anyio import to_thread

from fibaction.client.kept_connection import KeptBlock

pytestmark = pytest.mark.anyio


class Held:
    """A block that belongs to the task that enters it, as one with a task group does."""

    def __init__(self, fault: str = "") -> None:
        self.fault = fault
        self.entering, self.left = anyio.Event(), anyio.Event()

    @asynccontextmanager
    async def __call__(self) -> AsyncGenerator[str, None]:
        try:
            async with anyio.create_task_group():
                self.entering.set()
                if self.fault == "as it begins":
                    raise LookupError(self.fault)
                if self.fault == "never begins":
                    await anyio.sleep_forever()
                yield "held"
            if self.fault == "as it ends":
                raise LookupError(self.fault)
        finally:
            self.left.set()


async def test_it_is_left_in_the_task_that_has_entered_it() -> None:
    held = Held()
    block = KeptBlock(held())
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(block.open, "holder")
    assert (block.value, block.is_closing, block.error) == ("held", False, None)
    await to_thread.run_sync(block.close_soon)
    with anyio.fail_after(5):
        await block.ended.wait()
    assert held.left.is_set()
    assert (block.is_closing, block.error) == (True, None)
    block.close()  # once more, which does nothing


async def test_an_error_of_its_begin_is_raised_at_once() -> None:
    block = KeptBlock(Held("as it begins")())
    with pytest.raises(ExceptionGroup) as caught:
        await block.open("holder")
    assert caught.group_contains(LookupError)


async def test_an_error_of_its_end_is_kept() -> None:
    block = KeptBlock(Held("as it ends")())
    await block.open("holder")
    block.close()
    await block.ended.wait()
    assert isinstance(block.error, LookupError)


async def test_a_canceled_wait_for_its_begin_ends_it() -> None:
    held = Held("never begins")
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(KeptBlock(held()).open, "holder")
        await held.entering.wait()
        tasks.cancel_scope.cancel()
    assert held.left.is_set()

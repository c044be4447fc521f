"""Tasks in the background, and the slices in which work is done."""

from __future__ import annotations

import asyncio  # noqa: TID251  # whose tasks can be canceled without a scope
from collections.abc import Coroutine
from typing import Any

import anyio
import pytest

from fibaction.border import event_loop as slices_module
from fibaction.border.event_loop import SLICE, Background, Slices

pytestmark = pytest.mark.anyio


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


class Helper:
    """A task that runs for ever, and takes a while to clean up."""

    def __init__(self) -> None:
        self.started = anyio.Event()
        self.cleaned_up = False

    async def __call__(self) -> None:
        try:
            self.started.set()
            await anyio.sleep_forever()
        finally:
            with anyio.CancelScope(shield=True):
                await anyio.wait_all_tasks_blocked()
            self.cleaned_up = True


async def test_tasks_run_during_the_block_and_end_with_it() -> None:
    helpers = [Helper(), Helper()]
    with anyio.fail_after(5):
        async with Background() as tasks:
            for helper in helpers:
                tasks.start_soon(helper)
                await helper.started.wait()
            assert not any(helper.cleaned_up for helper in helpers)
    assert all(helper.cleaned_up for helper in helpers)


async def test_the_exception_of_the_block_goes_on_as_itself_after_the_tasks_have_ended() -> None:
    helper = Helper()
    error = LookupError("of the block")
    with anyio.fail_after(5), pytest.raises(LookupError) as caught:
        async with Background() as tasks:
            tasks.start_soon(helper)
            await helper.started.wait()
            raise error
    assert caught.value is error
    assert helper.cleaned_up


async def test_a_block_that_is_canceled_ends_its_tasks_and_goes_no_further() -> None:
    helper = Helper()
    went_on = False
    with anyio.fail_after(5):
        with anyio.CancelScope() as scope:
            async with Background() as tasks:
                tasks.start_soon(helper)
                await helper.started.wait()
                scope.cancel()
                await anyio.sleep_forever()
            went_on = True
        assert scope.cancelled_caught
    assert helper.cleaned_up
    assert not went_on


async def test_a_task_that_fails_ends_the_block_and_is_not_silent() -> None:
    async def fail() -> None:
        raise LookupError("of a task")

    helper = Helper()
    with anyio.fail_after(5), pytest.raises(ExceptionGroup) as caught:
        async with Background() as tasks:
            tasks.start_soon(helper)
            await helper.started.wait()
            tasks.start_soon(fail)
            await anyio.sleep_forever()
    assert caught.value.subgroup(LookupError) is not None
    assert helper.cleaned_up


async def test_its_tasks_go_on_while_a_block_that_was_canceled_is_left() -> None:
    helped = []
    wanted, done = anyio.Event(), anyio.Event()

    async def help_once() -> None:
        await wanted.wait()
        helped.append(True)
        done.set()

    with anyio.fail_after(5), anyio.CancelScope() as scope:
        async with Background() as tasks:
            tasks.start_soon(help_once)
            try:
                scope.cancel()
                await anyio.sleep_forever()
            finally:
                with anyio.CancelScope(shield=True):
                    wanted.set()
                    await done.wait()
    assert helped == [True]


async def test_a_task_that_is_started_just_before_an_error_can_clean_up_what_it_was_given() -> None:
    given: list[str] = []

    async def answer() -> None:
        try:
            await anyio.sleep_forever()
        finally:
            given.append("cleaned up")

    async def wait_for(answering: Coroutine[Any, Any, None]) -> None:
        await answering

    with anyio.fail_after(5), anyio.CancelScope() as scope:
        with pytest.raises(LookupError):
            async with Background() as tasks:
                scope.cancel()
                tasks.start_soon(wait_for, answer())
                raise LookupError
    assert given == ["cleaned up"]


@pytest.mark.parametrize("anyio_backend", ["asyncio"])
@pytest.mark.parametrize("turns", range(5))
async def test_a_task_that_is_itself_canceled_on_its_way_in_leaves_nothing_behind(
    turns: int,
) -> None:
    async def enters() -> None:
        async with Background():
            await anyio.sleep_forever()

    before = asyncio.all_tasks()
    task = asyncio.create_task(enters())
    for _ in range(turns):
        await asyncio.sleep(0)
    task.cancel()
    with anyio.fail_after(5):
        await asyncio.wait([task])
    assert task.cancelled()
    assert asyncio.all_tasks() == before


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time, in the only item of a list."""
    times = [100.0]
    monkeypatch.setattr(slices_module, "perf_counter", lambda: times[0])
    return times


async def test_others_have_a_turn_when_a_slice_is_over_and_not_before(now: list[float]) -> None:
    turns: list[float] = []

    async def take_turns() -> None:
        while True:
            turns.append(now[0])
            await anyio.lowlevel.checkpoint()

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(take_turns)
        slices = Slices()
        for step in (0.0, SLICE / 2):
            now[0] += step
            await slices.pause()
        assert turns == []
        for _ in range(5):
            now[0] += SLICE
            await slices.pause()
        assert len(turns) >= 3
        turns.clear()
        await slices.pause()  # the next slice begins after the pause
        assert turns == []
        tasks.cancel_scope.cancel()


async def test_a_cancellation_does_not_arrive_in_a_pause(now: list[float]) -> None:
    with anyio.CancelScope() as scope:
        scope.cancel()
        slices = Slices()
        now[0] += SLICE
        await slices.pause()
        now[0] = 0.0
    assert now == [0.0]

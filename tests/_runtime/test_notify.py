"""`fibaction._runtime.notify`: who is woken, and when."""

from __future__ import annotations

import gc

import anyio
import pytest

from fibaction._runtime.notify import Notifier


@pytest.mark.asyncio
async def test_notifying_wakes_all_that_wait_and_none_that_comes_later() -> None:
    waking = Notifier()
    woken: list[int] = []

    async def wait(number: int) -> None:
        await waking.wait()
        woken.append(number)

    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            waking.notify()
            tasks.start_soon(wait, 1)
            tasks.start_soon(wait, 2)
            await anyio.wait_all_tasks_blocked()
            assert woken == []
            waking.notify()
            tasks.start_soon(wait, 3)
            await anyio.wait_all_tasks_blocked()
            assert sorted(woken) == [1, 2]
            waking.notify()
    assert sorted(woken) == [1, 2, 3]


def test_the_listener_is_called_at_the_next_wake_only_whether_or_not_a_task_waits() -> None:
    waking = Notifier()
    calls: list[str] = []
    waking.notify()
    waking.on_next = lambda: calls.append("heard")
    assert calls == []  # what was before is none of its business
    waking.notify()
    assert calls == ["heard"]
    waking.notify()
    assert calls == ["heard"]
    waking.on_next = lambda: calls.append("heard again")
    waking.on_next = None
    waking.notify()
    assert calls == ["heard"]


@pytest.mark.asyncio
async def test_a_listener_may_wake_and_listen_again() -> None:
    waking = Notifier()
    rounds: list[int] = []

    def wake_once_more() -> None:
        rounds.append(len(rounds))
        if len(rounds) == 1:
            waking.on_next = wake_once_more
            waking.notify()

    waking.on_next = wake_once_more
    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(waking.wait)
            await anyio.wait_all_tasks_blocked()
            waking.notify()
    assert rounds == [0, 1]


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_a_notifier_wakes_the_tasks_of_either_loop_again_and_again(backend: str) -> None:
    waking = Notifier()

    async def wake() -> int:
        rounds = 0
        while rounds < 3:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(waking.wait)
                tasks.start_soon(waking.wait)
                await anyio.wait_all_tasks_blocked()
                waking.notify()
            rounds += 1
        return rounds

    assert anyio.run(wake, backend=backend) == 3


@pytest.mark.asyncio
async def test_a_task_that_is_canceled_in_the_turn_of_the_wake_does_not_disturb_the_others() -> (
    None
):
    waking = Notifier()
    woken: list[str] = []

    async def wait(scope: anyio.CancelScope, name: str) -> None:
        with scope:
            await waking.wait()
            woken.append(name)

    impatient = anyio.CancelScope()
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(wait, impatient, "the canceled one")
        tasks.start_soon(wait, anyio.CancelScope(), "the other")
        await anyio.wait_all_tasks_blocked()
        impatient.cancel()
        waking.notify()
    assert woken == ["the other"]
    assert impatient.cancelled_caught


@pytest.mark.asyncio
async def test_waits_that_were_canceled_leave_nothing_behind() -> None:
    waking = Notifier()
    for _ in range(10):
        with anyio.move_on_after(0):
            await waking.wait()
    gc.collect()
    futures = [one for one in gc.get_referents(waking) if isinstance(one, list)]
    assert futures in ([], [[]])

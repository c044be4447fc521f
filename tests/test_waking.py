"""`fibaction.waking`: who is woken, and when."""

from __future__ import annotations

import anyio
import pytest

from fibaction.waking import Waking


@pytest.mark.asyncio
async def test_waking_wakes_all_who_wait_and_nobody_who_comes_later() -> None:
    waking = Waking()
    woken: list[int] = []

    async def wait(number: int) -> None:
        await waking.wait()
        woken.append(number)

    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            waking.wake()
            tasks.start_soon(wait, 1)
            tasks.start_soon(wait, 2)
            await anyio.wait_all_tasks_blocked()
            assert woken == []
            waking.wake()
            tasks.start_soon(wait, 3)
            await anyio.wait_all_tasks_blocked()
            assert sorted(woken) == [1, 2]
            waking.wake()
    assert sorted(woken) == [1, 2, 3]


@pytest.mark.asyncio
async def test_the_wait_of_one_that_is_canceled_leaves_the_others_waiting() -> None:
    waking = Waking()
    woken: list[int] = []

    async def wait(number: int, scope: anyio.CancelScope) -> None:
        with scope:
            await waking.wait()
            woken.append(number)

    impatient = anyio.CancelScope()
    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(wait, 1, impatient)
            tasks.start_soon(wait, 2, anyio.CancelScope())
            await anyio.wait_all_tasks_blocked()
            impatient.cancel()
            await anyio.wait_all_tasks_blocked()
            assert woken == []
            waking.wake()
    assert woken == [2]


def test_the_listener_is_called_at_the_next_wake_only_whether_or_not_somebody_waits() -> None:
    waking = Waking()
    calls: list[str] = []
    waking.wake()
    waking.listener = lambda: calls.append("heard")
    assert calls == []  # what was before is none of its business
    waking.wake()
    assert calls == ["heard"]
    waking.wake()
    assert calls == ["heard"]
    waking.listener = lambda: calls.append("heard again")
    waking.listener = None
    waking.wake()
    assert calls == ["heard"]


@pytest.mark.asyncio
async def test_the_listener_and_those_who_wait_all_hear_of_the_same_wake() -> None:
    waking = Waking()
    heard: list[str] = []
    waking.listener = lambda: heard.append("the listener")

    async def wait(name: str) -> None:
        await waking.wait()
        heard.append(name)

    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(wait, "one")
            tasks.start_soon(wait, "other")
            await anyio.wait_all_tasks_blocked()
            assert heard == []
            waking.wake()
            # It hears at once; those who wait go on when they have their turn.
            assert heard == ["the listener"]
    assert sorted(heard) == ["one", "other", "the listener"]


@pytest.mark.asyncio
async def test_a_listener_may_wake_and_listen_again() -> None:
    waking = Waking()
    rounds: list[int] = []

    def wake_once_more() -> None:
        rounds.append(len(rounds))
        if len(rounds) == 1:
            waking.listener = wake_once_more
            waking.wake()

    waking.listener = wake_once_more
    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(waking.wait)
            await anyio.wait_all_tasks_blocked()
            waking.wake()
    assert rounds == [0, 1]

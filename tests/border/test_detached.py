from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

import anyio
import pytest
from anyio.abc import TaskGroup

from fibaction.border import detached as detached_module
from fibaction.border.detached import DetachedGroup, waker

pytestmark = pytest.mark.anyio


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


def nothing() -> None:
    """Do nothing about tasks that are overdue."""


def detached(
    owner: TaskGroup,
    *jobs: Callable[[], Coroutine[Any, Any, None]],
    on_overdue: Callable[[], None] = nothing,
    grace: float = 5,
) -> DetachedGroup:
    """Open a group that runs these jobs."""

    def start(tasks: TaskGroup) -> None:
        for job in jobs:
            tasks.start_soon(job)

    return DetachedGroup(owner, "detached", on_open=start, on_overdue=on_overdue, grace=grace)


async def test_the_owner_waits_for_the_tasks_of_a_detached_group() -> None:
    go = anyio.Event()
    ended: list[str] = []

    async def job() -> None:
        await go.wait()
        ended.append("job")

    with anyio.fail_after(5):
        async with anyio.create_task_group() as owner:
            group = detached(owner, job)
            await anyio.wait_all_tasks_blocked()
            owner.cancel_scope.cancel()  # does not reach the tasks
            group.close()
            with anyio.CancelScope(shield=True):
                await anyio.wait_all_tasks_blocked()
            assert ended == []
            go.set()
        assert ended == ["job"]


async def test_an_error_in_a_detached_group_is_raised_by_its_owner() -> None:
    error = KeyError("a")

    async def fail() -> None:
        raise error

    with anyio.fail_after(5), pytest.raises(ExceptionGroup) as caught:
        async with anyio.create_task_group() as owner:
            detached(owner, fail)
            await anyio.sleep_forever()
    assert caught.value.exceptions == (error,)


async def test_several_errors_in_a_detached_group_are_all_raised_by_its_owner() -> None:
    async def fail() -> None:
        raise KeyError

    with anyio.fail_after(5), pytest.raises(ExceptionGroup) as caught:
        async with anyio.create_task_group() as owner:
            detached(owner, fail, fail)
            await anyio.sleep_forever()
    (group,) = caught.value.exceptions
    assert isinstance(group, ExceptionGroup)
    assert len(group.exceptions) == 2


async def test_the_owner_leaves_overdue_tasks_behind() -> None:
    go, ended = anyio.Event(), anyio.Event()
    overdue: list[bool] = []

    async def job() -> None:
        with anyio.CancelScope(shield=True):
            await go.wait()
        ended.set()

    with anyio.fail_after(5):
        async with anyio.create_task_group() as owner:
            detached(owner, job, on_overdue=lambda: overdue.append(True), grace=0.01).close()
        assert overdue == [True]
        assert not ended.is_set()
        go.set()
        await ended.wait()
        await anyio.wait_all_tasks_blocked()


async def test_the_end_of_the_wait_of_an_overdue_task_is_waited_for() -> None:
    ended: list[str] = []
    wakers: list[Callable[[], object]] = []

    async def job() -> None:
        wakers.append(waker())
        try:
            with anyio.CancelScope(shield=True):
                await anyio.sleep_forever()
        except BaseException as exc:
            ended.append(type(exc).__name__)

    def wake() -> None:
        wakers[0]()
        wakers[0]()  # it has no effect on a task that does not wait

    with anyio.fail_after(5):
        async with anyio.create_task_group() as owner:
            detached(owner, job, on_overdue=wake, grace=0.01).close()
        assert ended in (["CancelledError"], ["RuntimeError"])


async def test_the_complaint_about_an_abandoned_task_is_dropped_and_other_errors_are_not() -> None:
    async def complains() -> None:
        raise RuntimeError("Attempted to exit a cancel scope that isn't the current one")

    async def fails() -> None:
        raise KeyError

    with anyio.fail_after(5):
        async with anyio.create_task_group() as owner:
            detached(owner, complains).has_abandoned = True
        with pytest.raises(ExceptionGroup) as caught:
            async with anyio.create_task_group() as owner:
                detached(owner, complains, fails).has_abandoned = True
    assert isinstance(caught.value.exceptions[0], KeyError)


@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_the_end_of_the_event_loop_ends_a_detached_group_and_its_owner() -> None:
    with anyio.fail_after(5):
        async with anyio.create_task_group() as owner:
            detached(owner)
            await anyio.wait_all_tasks_blocked()
            for task in tuple(detached_module._outside):
                task.cancel()

"""`Report`: feedback from helpers, tasks, callbacks and threads of a function."""

from __future__ import annotations

import math
import threading
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest
from anyio import to_thread
from anyio.lowlevel import checkpoint

from fibaction import (
    ActionClient,
    ActionServer,
    GoalCanceled,
    GoalHandle,
    GoalStatus,
    Outcome,
    Report,
    action,
)
from fibaction.server.functions import report as reports

pytestmark = pytest.mark.anyio


@asynccontextmanager
async def client_of(
    function: Any, *, window: int = 64, **settings: Any
) -> AsyncGenerator[ActionClient[int, int, str], None]:
    """Serve a function, and give a client. What holds longer than some seconds fails."""
    server = ActionServer(function, feedback_window=window, stall_timeout=math.inf, **settings)
    with anyio.fail_after(10):
        async with server:
            yield ActionClient(server, function)


@pytest.mark.parametrize("window", [1, 2, 64])
async def test_reports_of_several_tasks_come_one_after_another_and_none_is_lost(
    window: int,
) -> None:
    @action("count")
    async def count(goal: int, report: Report[int]) -> str:
        async def part(first: int) -> None:
            for number in range(first, 10 * goal, goal):
                await report(number)

        async with anyio.create_task_group() as tasks:
            for first in range(goal):
                tasks.start_soon(part, first)
        return "done"

    found: list[int] = []
    async with client_of(count, window=window) as client:
        assert await client.call(4, on_feedback=found.append) == "done"
    assert sorted(found) == [*range(40)]
    for first in range(4):
        assert [number for number in found if number % 4 == first] == [*range(first, 40, 4)]


async def test_a_callback_that_outruns_the_reader_pushes_the_oldest_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reports, "MOST_LATE", 2)

    @action("count")
    async def count(goal: int, report: Report[int]) -> str:
        async def wait() -> None:
            await report(0)
            await report(1)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(wait)
            await anyio.wait_all_tasks_blocked()  # it waits with a full window
            for number in range(2, goal):
                report(number)
        return "done"

    async with client_of(count, window=2) as client:
        async with client.send_goal(7) as goal:
            await anyio.wait_all_tasks_blocked()
            found = [number async for number in goal.feedback]
            assert goal.feedback.dropped == 7 - len(found) > 0
            assert found == sorted(found)
            assert found[-1] == 6


@pytest.mark.parametrize("ends", [False, True])
async def test_feedback_of_a_task_that_is_canceled_while_it_waits_is_sent_all_the_same(
    ends: bool,
) -> None:
    @action("count")
    async def count(goal: int, report: Report[int]) -> str:
        async def part(number: int) -> None:
            await report(number)

        with anyio.move_on_after(math.inf) as scope:
            async with anyio.create_task_group() as tasks:
                for number in range(2):
                    tasks.start_soon(part, number)
                    await anyio.wait_all_tasks_blocked()
                scope.cancel()
        if not ends:
            await report(2)
        return "done"

    async with client_of(count, window=1) as client:
        async with client.send_goal(3) as goal:
            await anyio.wait_all_tasks_blocked()
            found = [number async for number in goal.feedback]
            assert len(found) + goal.feedback.dropped == (2 if ends else 3)
            assert found[-1] == (1 if ends else 2)


@pytest.mark.parametrize("own_thread", [False, True])
async def test_a_thread_reports_and_waits_until_there_is_room(own_thread: bool) -> None:
    reported: list[int] = []

    def work(goal: int, report: Report[int]) -> None:
        for number in range(goal):
            report(number)
            reported.append(number)

    @action("count")
    async def count(goal: int, report: Report[int]) -> str:
        if own_thread:
            thread = threading.Thread(target=work, args=(goal, report))
            thread.start()
            await to_thread.run_sync(thread.join)
        else:
            await to_thread.run_sync(work, goal, report)
        return "done"

    async with client_of(count, window=1) as client:
        async with client.send_goal(5) as goal:
            async for number in goal.feedback:
                assert reported == [*range(number)]
            assert await goal.result() == "done"
    assert reported == [*range(5)]


class Ends:
    """What a function saw of its end."""

    def __init__(self) -> None:
        self.errors: list[str] = []

    def note(self, exc: BaseException) -> None:
        self.errors.append(type(exc).__name__)


async def canceled_at_the_first(function: Any, *, window: int = 1) -> Outcome[str]:
    """Cancel a goal once it has reported, without reading its feedback; return its outcome."""
    async with client_of(function, window=window) as client:
        async with client.send_goal(1000) as goal:
            async for _ in goal.feedback:
                break
            assert (await goal.cancel()).accepted
            return await goal.outcome()


@pytest.mark.parametrize("own_thread", [False, True])
async def test_a_cancel_arrives_in_a_thread_that_waits_in_its_report(own_thread: bool) -> None:
    seen = Ends()

    def work(goal: int, report: Report[int]) -> None:
        try:
            for number in range(goal):
                report(number)
        except GoalCanceled as exc:
            seen.note(exc)
            if not own_thread:
                raise

    @action("count")
    async def count(goal: int, report: Report[int]) -> str:
        if not own_thread:
            await to_thread.run_sync(work, goal, report)
        thread = threading.Thread(target=work, args=(goal, report))
        thread.start()
        await to_thread.run_sync(thread.join)
        await checkpoint()  # the cancel has arrived in the thread
        raise GoalCanceled(result="a part")

    outcome = await canceled_at_the_first(count)
    assert outcome.status is GoalStatus.CANCELED
    assert outcome.result == ("a part" if own_thread else None)
    assert seen.errors == ["GoalCanceled"]


async def test_a_cancel_ends_the_wait_of_a_thread_for_a_reader_that_does_not_read() -> None:
    full, noted = threading.Event(), threading.Event()

    @action("count")
    def count(goal: int, report: Report[int]) -> str:
        full.set()  # the first report fills the window
        try:
            report(1)
        except GoalCanceled:
            noted.set()
            raise
        return "done"

    async with client_of(count, window=1) as client:
        async with client.send_goal(1) as goal:
            assert await to_thread.run_sync(full.wait, 5)
            await anyio.wait_all_tasks_blocked()
            assert (await goal.cancel()).accepted
            assert await to_thread.run_sync(noted.wait, 5)
            assert (await goal.outcome()).status is GoalStatus.CANCELED


async def test_after_the_end_a_report_raises_one_error() -> None:
    kept: list[Any] = []

    @action("count")
    async def count(goal: GoalHandle[int], report: Report[int]) -> str:
        await report(1)
        kept.extend((report, goal))
        return "done"

    async with client_of(count) as client:
        await client.call(1)
    report, handle = kept
    text = "this report is of a goal whose function has ended"
    with pytest.raises(RuntimeError, match=text):
        report(2)
    with pytest.raises(RuntimeError, match=text):
        await to_thread.run_sync(report, 2)
    with pytest.raises(
        RuntimeError, match=r"goal \w+ does not run here now: use its handle while it runs"
    ):
        handle.check()

"""`fibaction.server.execution.task_pool`: jobs begin at once, and tasks are used again."""

from __future__ import annotations

import json
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from contextvars import copy_context
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import anyio
import anyio.lowlevel
import pytest

from fibaction.server.execution.executor_ends import MOST_KILLS
from fibaction.server.execution.interruption import CancelOnce, ScopesPhase, Stepper
from fibaction.server.execution.task_pool import GRACE, MOST_IDLE, TaskPool
from fibaction.server.execution.turns import EXECUTOR_SLICE, Turns
from tests.support.processes import PATIENCE
from tests.support.refusing import REFUSING, SHUTDOWN_TIMEOUT

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.anyio


class Bench:
    """A crew, and jobs that note which task they were done in."""

    def __init__(self, crew: TaskPool) -> None:
        self.crew = crew
        self.done: list[int] = []
        self.tasks: list[int] = []
        self.names: set[str | None] = set()
        self.go_on = anyio.Event()

    def note(self, number: int) -> None:
        task = anyio.get_current_task()
        self.done.append(number)
        self.tasks.append(task.id)
        self.names.add(task.name)

    def add(self, number: int) -> None:
        """A job that does not wait."""

        async def job(scopes: CancelOnce) -> None:
            self.note(number)

        self.crew.add(job)

    def add_waiting(self, number: int) -> None:
        """One that waits until it is to go on."""

        async def job(scopes: CancelOnce) -> None:
            self.note(number)
            scopes.on_wait()
            await self.go_on.wait()
            self.done.append(-number)

        self.crew.add(job)

    async def all_done(self, count: int) -> None:
        with anyio.fail_after(5):
            while len(self.done) < count:
                await anyio.lowlevel.checkpoint()
            await anyio.wait_all_tasks_blocked()


@asynccontextmanager
async def running(**settings: Any) -> AsyncGenerator[Bench, None]:
    """A crew, closed at the end; all of its tasks must end by that, or after the grace."""
    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            bench = Bench(TaskPool(tasks, "worker", **settings))
            try:
                await anyio.wait_all_tasks_blocked()  # its group is open then
                yield bench
            finally:
                bench.crew.close()


async def test_jobs_that_do_not_wait_are_done_in_one_task_in_their_order() -> None:
    async with running() as bench:
        for number in range(100):
            bench.add(number)
        assert bench.done == []  # only in the next turn
        await bench.all_done(100)
        assert bench.done == list(range(100))
        assert len(set(bench.tasks)) == 1
        assert bench.names == {"worker"}


async def test_not_more_than_some_idle_tasks_are_kept() -> None:
    async with running() as bench:
        for number in range(1, MOST_IDLE + 10):
            bench.add_waiting(number)
        await bench.all_done(MOST_IDLE + 9)
        bench.go_on.set()
        await bench.all_done(2 * (MOST_IDLE + 9))
        assert len(bench.crew._idle) == MOST_IDLE


async def test_a_task_whose_job_was_interrupted_takes_no_other() -> None:
    async with running() as bench:
        all_scopes: list[CancelOnce] = []

        async def job(scopes: CancelOnce) -> None:
            all_scopes.append(scopes)
            bench.note(1)
            scopes.on_wait()
            with pytest.raises(anyio.get_cancelled_exc_class()):
                await anyio.sleep_forever()

        bench.crew.add(job)
        await bench.all_done(1)
        bench.add(2)
        await bench.all_done(2)
        all_scopes[0].interrupt()
        for number in (3, 4, 5):
            bench.add(number)
        await bench.all_done(5)
        assert all_scopes[0].phase is ScopesPhase.SPENT
        assert bench.tasks.count(bench.tasks[0]) == 1


async def test_an_interruption_arrives_even_if_the_task_is_known_only_later() -> None:
    async with running() as bench:
        scopes = CancelOnce(lambda: None)

        async def work() -> None:
            with scopes.rest:
                scopes.interrupt()
                await anyio.sleep_forever()

        task = bench.crew._tasks.start_soon(work)
        await anyio.wait_all_tasks_blocked()
        scopes.run_by(task)
        await task.wait()


async def test_jobs_that_never_wait_let_others_have_their_turns() -> None:
    now = 0.0

    def clock() -> float:
        return now

    seen: list[int] = []
    async with running(clock=clock) as bench:

        async def job(scopes: CancelOnce) -> None:
            nonlocal now
            now += EXECUTOR_SLICE / 2
            bench.note(1)

        for _ in range(10):
            bench.crew.add(job)
        while len(bench.done) < 10:
            await anyio.lowlevel.checkpoint()
            seen.append(len(bench.done))
    # A turn is two jobs; trio, which draws the order of tasks, may let two turns follow each other.
    assert max(later - earlier for earlier, later in pairwise([0, *seen])) <= 4


async def test_tasks_that_go_on_in_the_same_turn_share_one_slice() -> None:
    now = 0.0
    async with running(clock=lambda: now) as bench:
        for number in range(1, 9):
            bench.add_waiting(number)
        await bench.all_done(8)

        async def job(scopes: CancelOnce) -> None:
            nonlocal now
            now += EXECUTOR_SLICE
            bench.note(100)

        for _ in range(100):
            bench.crew.add(job)
        bench.go_on.set()
        most = before = 0
        while len(bench.done) < 8 + 8 + 100:
            await anyio.lowlevel.checkpoint()
            most = max(most, bench.done.count(100) - before)
            before = bench.done.count(100)
    assert most <= 4  # with a slice for each of the tasks it would be 8


async def test_a_job_of_another_key_does_not_wait_for_all_jobs_of_the_first() -> None:
    began: list[str] = []
    async with running() as bench:

        async def job(scopes: CancelOnce, key: str) -> None:
            began.append(key)
            bench.done.append(0)

        for _ in range(10_000):
            bench.crew.add(partial(job, key="many"), "many")
        for _ in range(3):
            bench.crew.add(partial(job, key="few"), "few")
        await bench.all_done(10_003)
    assert [number for number, key in enumerate(began) if key == "few"] == [1, 3, 5]


# Abandoned jobs


@pytest.mark.parametrize("is_waiting", [False, True], ids=["catches", "is shielded"])
async def test_the_owner_ends_without_a_job_that_does_not_end(is_waiting: bool) -> None:
    seen: list[str] = []
    all_scopes: list[CancelOnce] = []

    async def refuses() -> str:
        with anyio.CancelScope(shield=is_waiting):
            while True:
                try:
                    await anyio.sleep(1)
                except BaseException as exc:
                    seen.append(type(exc).__name__)
        raise AssertionError("it ended")

    async def job(scopes: CancelOnce) -> None:
        all_scopes.append(scopes)
        bench.note(1)
        seen.append(await Stepper(refuses(), scopes, copy_context(), lambda: "given up"))

    async with running(grace=0.01 if is_waiting else 5) as bench:
        bench.crew.add(job)
        await bench.all_done(1)
        all_scopes[0].kill()
    assert seen[-1] == "given up"
    assert len(seen) == (1 if is_waiting else MOST_KILLS + 1)
    assert all_scopes[0].phase is ScopesPhase.ABANDONED


async def test_a_job_is_given_up_once() -> None:
    given_up: list[str] = []
    scopes = CancelOnce(lambda: None, Turns())
    steps = Stepper(anyio.sleep_forever(), scopes, copy_context(), lambda: given_up.append("it"))

    steps.abandon()
    steps.abandon()

    assert given_up == ["it"]


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
async def test_a_program_ends_in_spite_of_executors_that_do_not(backend: str) -> None:
    command = [sys.executable, "-m", "tests.support.refusing", backend]
    with anyio.fail_after(PATIENCE):
        run = await anyio.run_process(command, check=False, cwd=ROOT)
    code, out, err = run.returncode, run.stdout.decode(), run.stderr.decode()
    assert code == 0, err
    found = json.loads(out)
    assert found["left"] >= SHUTDOWN_TIMEOUT + GRACE
    assert found["used"] < 0.1  # of half a second
    for executor in REFUSING:
        assert f"of action {executor.__name__!r} does not end" in err
    assert "Traceback" not in err

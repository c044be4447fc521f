"""A cancel arrives once, but code that is written for anyio is left as anyio leaves it."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, TypeAlias

import anyio
import httpx
import pytest
from anyio import to_process, to_thread
from anyio.lowlevel import checkpoint

from fibaction import (
    Action,
    ActionServer,
    GoalCanceled,
    GoalHandle,
    GoalStatus,
    Outcome,
    action,
    connect,
    serve,
)
from fibaction.words.goals import GoalID

pytestmark = pytest.mark.anyio

PATIENCE = 20.0
"""Seconds in which a goal ends; what it waits for takes longer."""


class Beside:
    """What an executor waits for, and the test that cancels it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        os.mkfifo(path)
        self._pipe = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        self.waits = anyio.Event()
        """Set when the executor waits."""
        self.done: list[str] = []

    @property
    def command(self) -> list[str]:
        """A process that says by a pipe that it runs, and then waits."""
        return ["sh", "-c", f"exec 3>{self.path}; echo >&3; exec sleep 60"]

    async def process_runs(self) -> None:
        await anyio.wait_readable(self._pipe)
        assert os.read(self._pipe, 9) == b"\n"
        self.waits.set()

    async def process_is_gone(self) -> None:
        await anyio.wait_readable(self._pipe)
        assert os.read(self._pipe, 9) == b""

    def close(self) -> None:
        os.close(self._pipe)


@pytest.fixture
def beside(tmp_path: Path) -> Any:
    made = Beside(tmp_path / "pipe")
    yield made
    made.close()


Wait: TypeAlias = Callable[[Beside], Awaitable[object]]
Run: TypeAlias = Callable[[Callable[[], Awaitable[None]]], Awaitable[Outcome[str]]]


def as_function(body: Callable[[], Awaitable[None]]) -> ActionServer[Any, Any, str]:
    @action("work")
    async def work() -> str:
        await body()
        return "done"

    return ActionServer(work)


def as_generator(body: Callable[[], Awaitable[None]]) -> ActionServer[Any, Any, str]:
    async def work(goal: GoalHandle[None]) -> AsyncGenerator[str, None]:
        await body()
        yield "done"

    return ActionServer(Action("work", goal=None, feedback=int, result=str), work)


@pytest.fixture(params=[as_function, as_generator])
def outcome_of(request: pytest.FixtureRequest, beside: Beside) -> Run:
    """Return what runs an executor, cancels it when it waits, and returns its outcome."""

    async def run(body: Callable[[], Awaitable[None]]) -> Outcome[str]:
        server = request.param(body)
        with anyio.fail_after(PATIENCE):
            async with serve(server, f"inproc://{GoalID.random()}") as (url,):
                async with connect(url, server.action) as client, client.send_goal() as goal:
                    await beside.waits.wait()
                    await anyio.wait_all_tasks_blocked()
                    await goal.cancel()
                    outcome: Outcome[str] = await goal.outcome()
                    return outcome

    return run


# What is waited for


async def run_process(beside: Beside) -> None:
    await anyio.run_process(beside.command)


async def open_process(beside: Beside) -> None:
    async with await anyio.open_process(beside.command) as process:
        await process.wait()


async def generator_within(beside: Beside) -> None:
    async with opened(beside):
        await anyio.sleep_forever()


@asynccontextmanager
async def opened(beside: Beside) -> AsyncGenerator[None, None]:
    async with await anyio.open_process(beside.command):
        yield


def hold(path: str) -> None:
    """Do in a process what `command` does."""
    with open(path, "w") as pipe:
        pipe.write("\n")
        pipe.flush()
        threading.Event().wait(60)


async def worker_process(beside: Beside) -> None:
    await to_process.run_sync(hold, str(beside.path), cancellable=True)


async def task_group(beside: Beside) -> None:
    async with anyio.create_task_group() as tasks:
        for _ in range(3):
            tasks.start_soon(anyio.sleep_forever)
        beside.waits.set()


async def process_in_a_group(beside: Beside) -> None:
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(anyio.sleep_forever)
        await open_process(beside)


async def timeout(beside: Beside) -> None:
    with anyio.move_on_after(60):
        beside.waits.set()
        await anyio.sleep_forever()


async def abandoned_thread(beside: Beside) -> None:
    stops = threading.Event()
    beside.waits.set()
    try:
        await to_thread.run_sync(stops.wait, 60, abandon_on_cancel=True)
    finally:
        stops.set()


async def full_stream(beside: Beside) -> None:
    sender, receiver = anyio.create_memory_object_stream[int](0)
    async with sender, receiver:
        beside.waits.set()
        await sender.send(1)


async def empty_stream(beside: Beside) -> None:
    sender, receiver = anyio.create_memory_object_stream[int](0)
    async with sender, receiver:
        beside.waits.set()
        await receiver.receive()


async def web_request(beside: Beside) -> None:
    async def is_silent(stream: Any) -> None:
        async with stream:
            beside.waits.set()
            await stream.receive()
            await anyio.sleep_forever()

    async with await anyio.create_tcp_listener(local_host="127.0.0.1") as listener:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(listener.serve, is_silent)
            port = listener.extra(anyio.abc.SocketAttribute.local_port)
            async with httpx.AsyncClient(trust_env=False) as client:
                await client.get(f"http://127.0.0.1:{port}/", timeout=None)


OF_PROCESSES: list[Wait] = [run_process, open_process, generator_within, worker_process]
OTHERS: list[Wait] = [
    task_group, timeout, abandoned_thread, full_stream, empty_stream, web_request,
]  # fmt: skip


@pytest.mark.skipif(sys.platform == "win32", reason="the processes speak by a named pipe")
@pytest.mark.parametrize("wait", [*OF_PROCESSES, process_in_a_group, *OTHERS])
async def test_code_of_anyio_is_left_at_once_and_clean_up_after_it_may_wait(
    wait: Wait, beside: Beside, outcome_of: Run
) -> None:
    async def body() -> None:
        try:
            await wait(beside)
        finally:
            # On trio, a group at whose end the executor waits hides the arrival of the cancel.
            with anyio.CancelScope(shield=wait is task_group):
                await anyio.sleep(0.01)
            beside.done.append("clean-up")

    async with anyio.create_task_group() as tasks:
        if wait in OF_PROCESSES or wait is process_in_a_group:
            tasks.start_soon(beside.process_runs)
        assert (await outcome_of(body)).status is GoalStatus.CANCELED
    assert beside.done == ["clean-up"]
    if wait in OF_PROCESSES:
        await beside.process_is_gone()


class Arm(anyio.abc.AsyncResource):
    """A resource of the user's: its clean-up waits."""

    def __init__(self, beside: Beside) -> None:
        self._beside = beside

    async def aclose(self) -> None:
        await anyio.sleep(0.01)
        self._beside.done.append("arm is home")


@pytest.mark.promise("CANCEL-6")
async def test_the_executors_own_clean_up_is_not_canceled_again(
    beside: Beside, outcome_of: Run
) -> None:
    async def body() -> None:
        try:
            async with Arm(beside):
                beside.waits.set()
                await anyio.sleep_forever()
        finally:
            await anyio.run_process(["sleep", "0.01"])
            beside.done.append("process has ended")

    assert (await outcome_of(body)).status is GoalStatus.CANCELED
    assert beside.done == ["arm is home", "process has ended"]


async def test_a_timeout_of_an_executor_that_goes_on_brings_no_second_cancel(
    beside: Beside, outcome_of: Run
) -> None:
    async def body() -> None:
        try:
            beside.waits.set()
            await anyio.sleep_forever()
        except anyio.get_cancelled_exc_class():
            await checkpoint()  # a process of trio may not be the first that clean-up waits for
            with anyio.move_on_after(0.01):
                await run_process(beside)
            await anyio.sleep(0.01)
            raise GoalCanceled(result="all the same") from None

    outcome = await outcome_of(body)
    assert (outcome.status, outcome.result) == (GoalStatus.CANCELED, "all the same")

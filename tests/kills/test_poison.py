"""A goal that ends its process, with others beside it: which of them are given up."""

from __future__ import annotations

import os
from collections.abc import AsyncGenerator
from contextlib import ExitStack
from multiprocessing import get_context
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import anyio
import pytest

from fibaction import ActionServer, GoalHandle, GoalStatus, Outcome, SqliteStore, connect, serve
from tests.kills.victim import WORK, Done, Work
from tests.support.nats_server import IS_LEFT_OUT, nats_server
from tests.support.ports import free_port

INNOCENT, POISON = 0, 1
PATIENCE = 120.0
"""Seconds for four processes, or the leases of a fleet, on a busy machine."""


async def work(goal: GoalHandle[Work]) -> AsyncGenerator[int | Done, None]:
    """Take a step, and end the process if the goal is the one that does so."""
    await anyio.sleep(goal.request.pause)
    if goal.request.key == POISON:
        os._exit(7)
    yield 1
    await anyio.sleep(goal.request.pause)
    yield Done(2, goal.attempt)


async def serve_for_ever(url: str, path: str) -> None:
    """Serve until a goal ends the process, or a test does."""
    store = SqliteStore(path) if path else None
    async with serve(ActionServer(WORK, work, store=store, recovery="rerun"), url):
        await anyio.sleep_forever()


def run_process(url: str, path: str) -> None:
    """Run `serve_for_ever` in this process."""
    anyio.run(serve_for_ever, url, path)


async def keep_running(*servers: tuple[str, str]) -> None:
    """Run processes with these addresses and stores, and start each again that has ended."""
    context = get_context("forkserver")
    context.set_forkserver_preload(["tests.kills.test_poison"])
    running: dict[tuple[str, str], ForkServerProcess] = {}
    try:
        while True:
            for one in servers:
                if one not in running or not running[one].is_alive():
                    running[one] = context.Process(target=run_process, args=one)
                    running[one].start()
            await anyio.sleep(0.05)
    finally:
        for process in running.values():
            process.kill()
            process.join()


async def outcomes_of(url: str, *servers: tuple[str, str]) -> list[Outcome[Done]]:
    """Send a poison and three innocent goals, and return their ends in this order."""
    found: dict[int, Outcome[Done]] = {}

    async def send(number: int, kind: int) -> None:
        goal = await client.send_goal(Work(2, 0.3, key=kind))
        found[number] = await goal.outcome()

    with anyio.fail_after(PATIENCE):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(keep_running, *servers)
            async with connect(url, WORK, reconnect_timeout=PATIENCE) as client:
                await client.wait_for_server()
                async with anyio.create_task_group() as goals:
                    for number, kind in enumerate((POISON, INNOCENT, INNOCENT, INNOCENT)):
                        goals.start_soon(send, number, kind)
            tasks.cancel_scope.cancel()
    return [found[number] for number in sorted(found)]


@pytest.mark.promise("KEEP-13")
@pytest.mark.timeout(240)
@pytest.mark.parametrize(
    "kind",
    [
        "store",
        pytest.param("fleet", marks=pytest.mark.skipif(IS_LEFT_OUT, reason="no nats-server")),
    ],
)
def test_a_goal_that_ends_its_process_is_given_up_and_its_neighbours_succeed(
    tmp_path: Path, kind: str
) -> None:
    with ExitStack() as stack:
        if kind == "store":
            url = f"tcp://127.0.0.1:{free_port()}"
            servers = [(url, str(tmp_path / "goals.db"))]
        else:
            url = f"nats://{stack.enter_context(nats_server()).address}/poison"
            servers = [(f"{url}?worker={name}&lease=5", "") for name in ("w1", "w2")]
        poison, *innocent = anyio.run(outcomes_of, url, *servers)
    assert poison.status is GoalStatus.ABORTED
    assert poison.reason.startswith("given up after 3 attempts: the ")
    assert [one.status for one in innocent] == [GoalStatus.SUCCEEDED] * 3

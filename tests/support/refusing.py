"""Executors that do not end though they are killed, and a program that leaves their servers.

    python -m tests.support.refusing asyncio

prints, as JSON, the seconds that leaving took, the processor's seconds of the time that follows,
and the tasks that are left; then it has to end by itself.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import AsyncGenerator
from contextlib import suppress
from threading import Event

import anyio
import anyio.lowlevel

from fibaction import Action, ActionClient, ActionServer, GoalHandle

Items = AsyncGenerator[int | str, None]

SHUTDOWN_TIMEOUT = 0.05
thread_may_end, thread_began = Event(), anyio.Event()


async def sleeps_again(goal: GoalHandle[int]) -> Items:
    yield 1
    while True:
        with suppress(BaseException):
            await anyio.sleep(1)


async def gives_way_again(goal: GoalHandle[int]) -> Items:
    yield 1
    while True:
        with suppress(BaseException):
            await anyio.lowlevel.checkpoint()


async def yields_again(goal: GoalHandle[int]) -> Items:
    while True:
        with suppress(BaseException):
            yield 1


async def has_a_shield(goal: GoalHandle[int]) -> Items:
    yield 1
    with anyio.CancelScope(shield=True):
        await anyio.sleep_forever()


async def has_a_timeout_around_it(goal: GoalHandle[int]) -> Items:
    yield 1
    with anyio.move_on_after(0.3):
        while True:
            with suppress(BaseException):
                await anyio.sleep(10)


async def has_an_endless_clean_up(goal: GoalHandle[int]) -> Items:
    try:
        yield 1
        await anyio.sleep_forever()
    finally:
        while True:
            with suppress(BaseException):
                await anyio.sleep(0.01)


async def cannot_be_closed(goal: GoalHandle[int]) -> Items:
    try:
        yield 1
        yield None  # type: ignore[misc]  # it is wrong, and closed for that
    except GeneratorExit:
        while True:
            with suppress(BaseException):
                await anyio.sleep(1)


async def has_a_task_group(goal: GoalHandle[int]) -> Items:
    yield 1
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(anyio.sleep_forever)
        while True:
            with suppress(BaseException):
                await anyio.sleep(1)


async def waits_for_a_thread(goal: GoalHandle[int]) -> Items:
    yield 1
    await anyio.to_thread.run_sync(wait_in_a_thread)


def wait_in_a_thread() -> None:
    anyio.from_thread.run_sync(thread_began.set)
    thread_may_end.wait()


REFUSING = (
    sleeps_again,
    gives_way_again,
    yields_again,
    has_a_shield,
    has_a_timeout_around_it,
    has_an_endless_clean_up,
    cannot_be_closed,
    has_a_task_group,
    waits_for_a_thread,
)


async def leave(server: ActionServer[int, int, str]) -> None:
    """Send a goal to a server, and leave its block."""
    async with server:
        goal = await ActionClient(server, server.action).send_goal(1)
        async for _ in goal.feedback:
            break
        await thread_began.wait()  # else that executor could be canceled before it refuses


async def main() -> None:
    began = time.monotonic()
    async with anyio.create_task_group() as tasks:
        for executor in REFUSING:
            action = Action(executor.__name__, goal=int, feedback=int, result=str)
            server = ActionServer(action, executor, shutdown_timeout=SHUTDOWN_TIMEOUT)
            tasks.start_soon(leave, server)
    left = time.monotonic() - began
    used = time.process_time()
    await anyio.sleep(0.5)
    used = time.process_time() - used
    thread_may_end.set()
    await anyio.sleep(0.05)
    print(json.dumps({"left": left, "used": used, "tasks": len(anyio.get_running_tasks())}))


if __name__ == "__main__":
    anyio.run(main, backend=sys.argv[1])

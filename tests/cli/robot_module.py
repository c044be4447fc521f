"""A module as users write them, as text: tests put it into a folder as `robot.py`."""

MODULE = """
import time
from collections.abc import AsyncGenerator

import anyio

from fibaction import Action, ActionServer, GoalHandle, GoalRejected

COUNT = Action("count", goal=int, feedback=int, result=str)
TELL = Action("arm/tell", goal=str, feedback=int, result=str)


def on_goal(goal: int) -> None:
    if goal < 0:
        raise GoalRejected("one cannot count down")


def sleep_in_thread() -> None:
    print("it is at work", flush=True)
    time.sleep(3600)


async def count(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    try:
        for number in range(goal.request):
            yield number
        if goal.request == 668:
            await anyio.to_thread.run_sync(sleep_in_thread, abandon_on_cancel=True)
        if goal.request in (666, 667):
            print("it is at work", flush=True)
        await anyio.sleep(0 if goal.request < 100 else 3600)
    finally:
        if goal.request in (666, 667):
            print("it does not want to go", flush=True)
            if goal.request == 667:
                time.sleep(3600)
            with anyio.CancelScope(shield=True):
                await anyio.sleep(3600)
    yield "counted"


async def tell(goal: GoalHandle[str]) -> AsyncGenerator[int | str, None]:
    yield goal.request


server = ActionServer(COUNT, count, on_goal=on_goal, shutdown_timeout=600)
several = (server, ActionServer(TELL, tell))
nested = type("Namespace", (), {"server": server})
empty = []
mixed = [server, 3]
number = 3


def make():
    return [ActionServer(TELL, tell)]


def make_one(name):
    return server


def make_nothing():
    return None


def fail():
    raise RuntimeError("the arm is not plugged in")


async def make_later():
    return server
"""

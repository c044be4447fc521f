"""A process that logs as docs/howto/secure.md shows: `log_victim.py serve`, or `connect URL`.

The server runs until its standard input ends. The client calls the server of the test, and logs
each error.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import AsyncGenerator
from typing import Any

import anyio
import msgspec
from anyio import to_thread

from fibaction import (
    Action,
    ActionError,
    ActionServer,
    CancelRejected,
    GoalAborted,
    GoalHandle,
    GoalRejected,
    connect,
    serve,
)


class Strict(msgspec.Struct, forbid_unknown_fields=True):
    """A goal that is decoded with the names of its fields."""


STRICT = Action("strict", goal=Strict, feedback=float, result=str)
NASTY = "\nWARNING root: forged \x1b[2J\x85\u2028\u202e"


async def never(goal: GoalHandle[Strict]) -> AsyncGenerator[float | str, None]:
    raise AssertionError
    yield ""


async def failing(goal: GoalHandle[str]) -> AsyncGenerator[float | str, None]:
    try:
        raise KeyError(goal.request)
    except KeyError as exc:
        raise ValueError(goal.request) from exc
    yield ""


async def grouping(goal: GoalHandle[str]) -> AsyncGenerator[float | str, None]:
    error = TypeError()
    error.add_note(goal.request)
    raise ExceptionGroup(goal.request, [ValueError(goal.request), error])
    yield ""


async def aborting(goal: GoalHandle[str]) -> AsyncGenerator[float | str, None]:
    yield 0.5
    raise GoalAborted(goal.request)


async def waiting(goal: GoalHandle[str]) -> AsyncGenerator[float | str, None]:
    await anyio.sleep_forever()
    yield ""


def picky(goal: str) -> None:
    raise GoalRejected(goal)


def broken(goal: str) -> None:
    raise RuntimeError(goal)


def stubborn(goal: GoalHandle[str]) -> None:
    raise CancelRejected(goal.request)


def server(name: str, executor: Any, **settings: Any) -> ActionServer[str, float, str]:
    action = Action(name, goal=str, feedback=float, result=str)
    return ActionServer(action, executor, **settings)


async def run_server() -> None:
    servers: list[ActionServer[Any, Any, Any]] = [
        ActionServer(STRICT, never),
        server("failing", failing),
        server("grouping", grouping),
        server("aborting", aborting),
        server("picky", failing, on_goal=picky),
        server("broken", failing, on_goal=broken),
        server("stubborn", waiting, on_cancel=stubborn, shutdown_timeout=0),
    ]
    async with serve(servers, "tcp://127.0.0.1:0", tokens={"secret": f"screen{NASTY}"}) as (url,):
        print(url, flush=True)
        await to_thread.run_sync(sys.stdin.read)


async def run_client(url: str) -> None:
    async with connect(url, STRICT, reconnect_timeout=0) as client:
        while True:
            try:
                await client.call(Strict())
            except ActionError as exc:
                logging.getLogger("robot").error("it failed: %s", exc)
                if not isinstance(exc, GoalRejected | GoalAborted):
                    return


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s: %(message)s")
    anyio.run(*((run_server,) if sys.argv[1] == "serve" else (run_client, sys.argv[2])))

"""A robot that keeps its goals in a store, for agents: `... PORT TOKEN STORE` serves it.

It prints its address. The first attempt at a goal never ends; the next one, after the robot was
started again, goes on from its checkpoint.
"""

from __future__ import annotations

import sys
from collections.abc import AsyncGenerator
from pathlib import Path

import anyio
import msgspec

from fibaction import Action, ActionServer, GoalHandle, SqliteStore, serve
from fibaction_transports.mcp import McpHttpTransport


class Way(msgspec.Struct):
    meters: int


class Place(msgspec.Struct):
    at: int
    begin: int


DRIVE = Action("drive", goal=Way, feedback=int, result=Place, checkpoint=int)


async def drive(goal: GoalHandle[Way]) -> AsyncGenerator[int | Place, None]:
    """Drive meter by meter, from the checkpoint on."""
    begin = goal.restored or 0
    for meter in range(begin, goal.request.meters):
        await goal.checkpoint(meter + 1)
        yield meter + 1
        if goal.attempt == 1:
            await anyio.sleep_forever()
    yield Place(goal.request.meters, begin)


async def main(*arguments: str) -> None:
    port, token, store = arguments
    server = ActionServer(
        DRIVE, drive, store=SqliteStore(Path(store)), recovery="rerun", result_timeout=600
    )
    transport = McpHttpTransport("127.0.0.1", int(port), token=token, unasked=["*"])
    async with serve(server, transport) as (url,):
        print(url, flush=True)
        await anyio.sleep_forever()


if __name__ == "__main__":
    anyio.run(main, *sys.argv[1:])

"""One version of fibaction at work: a server and its clients in one process, for `versions`.

It is run as a file, so that `fibaction` is that of `PYTHONPATH`, and uses nothing that an earlier
version does not have. It is told what to do in lines of JSON, and answers with the seconds of the
processor's time that it took. With `--uvloop` it runs on uvloop, and with `--function` the executor
is a function in place of a generator.
"""

from __future__ import annotations

import gc
import json
import sys
from collections.abc import AsyncGenerator, Awaitable, Callable
from time import process_time
from typing import Any

import anyio

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalHandle,
    Report,
    action,
    connect,
    serve,
)

COUNT = Action("count", goal=int, feedback=int, result=str)
AT_ONCE = 500

Client = ActionClient[Any, int, str]


async def count(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    """Yield as much feedback as the goal says."""
    for number in range(goal.request):
        yield number
    yield "done"


@action("count")
async def count_by_function(report: Report[int], times: int) -> str:
    """Report as much feedback as the goal says."""
    for number in range(times):
        await report(number)
    return "done"


async def goals(client: Client, times: int) -> None:
    """Run goals one after another."""
    for _ in range(times):
        await client.call(0)


async def batches(client: Client, times: int) -> None:
    """Run batches of goals that are sent at once."""
    for _ in range(times):
        async with anyio.create_task_group() as tasks:
            for _ in range(AT_ONCE):
                tasks.start_soon(client.call, 0)


async def feedback(client: Client, times: int) -> None:
    """Run one goal with so many feedback messages."""
    await client.call(times, on_feedback=lambda _: None)


ORDERS: dict[str, Callable[[Client, int], Awaitable[None]]] = {
    one.__name__: one for one in (goals, batches, feedback)
}


async def main() -> None:
    by_function = "--function" in sys.argv
    served: Action[Any, int, str] = count_by_function if by_function else COUNT
    server = ActionServer(count_by_function) if by_function else ActionServer(COUNT, count)
    async with (
        serve(server, "inproc://count", "tcp://127.0.0.1:0") as (here, there),
        connect(here, served) as inproc,
        connect(there, served) as tcp,
    ):
        clients = {"inproc": inproc, "tcp": tcp}
        print(json.dumps(sys.modules["fibaction"].__file__), flush=True)
        # Nothing else goes on between two orders, so the loop may wait here.
        while line := sys.stdin.readline():
            order = json.loads(line)
            where, _, work = order["do"].partition(" ")
            gc.collect()
            began = process_time()
            await ORDERS[work](clients[where], order["times"])
            print(json.dumps(process_time() - began), flush=True)


if __name__ == "__main__":
    anyio.run(main, backend_options={"use_uvloop": "--uvloop" in sys.argv})

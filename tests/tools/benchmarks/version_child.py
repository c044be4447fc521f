"""One version of fibaction at work: a server and its clients in one process, for `versions`.

It is run as a file, so that `fibaction` is that of `PYTHONPATH`, and uses nothing that an earlier
version does not have. It is told what to do in lines of JSON, and answers with the seconds of the
processor's time that it took. With `--uvloop` it runs on uvloop.
"""

from __future__ import annotations

import gc
import json
import sys
from collections.abc import AsyncGenerator, Awaitable, Callable
from time import process_time

import anyio

from fibaction import Action, ActionClient, ActionServer, GoalHandle, connect, serve

COUNT = Action("count", goal=int, feedback=int, result=str)
AT_ONCE = 500

Client = ActionClient[int, int, str]


async def count(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    """Yield as much feedback as the goal says."""
    for number in range(goal.request):
        yield number
    yield "done"


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
    server = ActionServer(COUNT, count)
    async with (
        serve(server, "inproc://count", "tcp://127.0.0.1:0") as (here, there),
        connect(here, COUNT) as inproc,
        connect(there, COUNT) as tcp,
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

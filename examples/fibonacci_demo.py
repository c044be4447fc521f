"""Server and client in one process: a goal that is canceled, one that succeeds, one rejected."""

from __future__ import annotations

from contextlib import suppress

import anyio
from fibonacci import FIBONACCI, MAX_ORDER, make_server
from fibonacci_client import run_goal

from fibaction import connect, serve

URL = "inproc://fibonacci-demo"


async def main() -> None:
    """Run three goals, one after the other."""
    async with serve(make_server(period=0.3), URL), connect(URL, FIBONACCI) as client:
        print("1. A goal that is canceled half-way ends with what there was by then.\n")
        await run_goal(client, 10, cancel_after=5)
        print("\n2. A goal that is left alone ends with all of it.\n")
        await run_goal(client, 10)
        print("\n3. A goal that cannot be met is rejected, and the server says why.\n")
        await run_goal(client, MAX_ORDER + 1)


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        anyio.run(main)

"""`python -m tests.hostile.attacker NAME URL WEB [TOKEN]`: an attack in a process of its own.

It repeats the long form of the attack until standard input ends, and then prints how many waves
there were.
"""

from __future__ import annotations

import sys

import anyio

from tests.hostile.arena import repeat
from tests.hostile.attacks import ATTACKS
from tests.hostile.raw_client import Target


async def main(name: str, url: str, web: str, token: str = "") -> None:
    waves: list[float] = []
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(repeat, ATTACKS[name], Target(url, token, web=web, is_long=True), waves)
        await anyio.to_thread.run_sync(sys.stdin.read, abandon_on_cancel=True)
        tasks.cancel_scope.cancel()
    print(len(waves), flush=True)


if __name__ == "__main__":
    anyio.run(lambda: main(*sys.argv[1:]))

"""`python -m tests.hostile.rtps.attacker NAME ...`: an attack in a process of its own.

It repeats the attack, as fast as it can, until it is killed or standard input ends.
"""

from __future__ import annotations

import sys

import anyio

from tests.hostile.rtps.crowd import repeat
from tests.hostile.rtps.datagram_attacks import attacker_of
from tests.hostile.rtps.echo_victim import EchoIdentity


async def main(name: str, domain: str, prefix: str, port: str, *entities: str) -> None:
    address = "127.0.0.1", int(port)
    victim = EchoIdentity(
        int(domain), bytes.fromhex(prefix), address, *map(bytes.fromhex, entities)
    )
    async with attacker_of(victim) as attacker, anyio.create_task_group() as tasks:
        print("it begins", flush=True)
        tasks.start_soon(lambda: repeat(name, attacker, [], is_long=True))
        await anyio.to_thread.run_sync(sys.stdin.read, abandon_on_cancel=True)
        tasks.cancel_scope.cancel()


if __name__ == "__main__":
    anyio.run(lambda: main(*sys.argv[1:]))

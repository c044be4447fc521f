"""`python -m tests.hostile.attacker NAME WHERE ...`: an attack in a process of its own.

It repeats the long form of the attack until it is killed, or standard input ends. `WHERE` is the
URL of a server, of its door for the web, and a token; or an `EchoIdentity`.
"""

from __future__ import annotations

import sys

import anyio

from tests.hostile import arena
from tests.hostile.attacks import ATTACKS
from tests.hostile.raw_client import Target
from tests.hostile.rtps import crowd
from tests.hostile.rtps.datagram_attacks import DATAGRAM_ATTACKS, attacker_of


async def main(name: str, *where: str) -> None:
    async with anyio.create_task_group() as tasks:
        if name in DATAGRAM_ATTACKS:
            tasks.start_soon(attack_by_datagrams, name, *where)
        else:
            url, web, token = where
            target = Target(url, token, web=web, is_long=True)
            tasks.start_soon(arena.repeat, ATTACKS[name], target, [])
        await anyio.to_thread.run_sync(sys.stdin.read, abandon_on_cancel=True)
        tasks.cancel_scope.cancel()


async def attack_by_datagrams(name: str, *victim: str) -> None:
    async with attacker_of(crowd.victim_in(victim)) as attacker:
        print("it begins", flush=True)
        await crowd.repeat(name, attacker, [], is_long=True)


if __name__ == "__main__":
    anyio.run(lambda: main(*sys.argv[1:]))

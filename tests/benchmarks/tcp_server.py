"""`python -m tests.benchmarks.tcp_server CONTENDER`: print the address, and serve until standard
input ends. So a server never outlives the benchmark, however that ends.
"""

from __future__ import annotations

import sys

import anyio

from tests.benchmarks.tcp import CONTENDERS


async def main() -> None:
    async with CONTENDERS[sys.argv[1]].serve() as address:
        print(address, flush=True)
        await anyio.to_thread.run_sync(sys.stdin.read, abandon_on_cancel=True)


if __name__ == "__main__":
    anyio.run(main)

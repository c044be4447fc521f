"""One run: a server in a process that is killed and started again, its clients, and the verdict."""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path

import anyio
import msgspec

from tests.kills.clients import Visitor, settle
from tests.kills.ledger import Ledger, Rules, attempts_of, faults_of
from tests.kills.victim import Setup, entries_of, run_victim
from tests.support.ports import free_port

LIFE = (0.0, 0.9)
"""The shortest and the longest life of a server, in seconds, from when clients can connect."""
BIRTH = 0.1
"""Seconds from the start of a process within which it is killed, if that is before it serves."""


class Report(msgspec.Struct):
    """The figures of a run, and the promises that were broken."""

    kills: int
    kills_before_it_served: int
    goals: int
    calls: Mapping[str, int]
    ends: Mapping[str, int]
    attempts: Mapping[int, int]
    faults: list[str]


class Keeper:
    """Starts the server's process, kills it, and starts it again."""

    def __init__(self, setup: Setup, seed: int) -> None:
        self._setup = setup
        self._chance = random.Random(seed)
        self._processes = get_context("forkserver")
        self._processes.set_forkserver_preload(["tests.kills.victim", "fibaction_transports.tcp"])
        self.kills = Counter[str]()

    async def kill_for(self, seconds: float) -> None:
        """Kill the server, and start it again, for so many seconds since the first one serves."""
        until = math.inf
        while anyio.current_time() < until:
            process, pipe = started(self._processes, run_victim, self._setup)
            if self._chance.random() < 0.2:
                await anyio.sleep(self._chance.uniform(0, BIRTH))
                kind = "served" if pipe.poll() else "not served"
            else:
                await serving(pipe)
                until = min(until, anyio.current_time() + seconds)
                await anyio.sleep(self._chance.uniform(*LIFE))
                kind = "served"
            process.kill()
            self.kills[kind] += 1
            process.join()
            pipe.close()

    @asynccontextmanager
    async def survivor(self) -> AsyncGenerator[None, None]:
        """Run a server that is stopped in good order at the end."""
        process, pipe = started(self._processes, run_victim, self._setup)
        try:
            await serving(pipe)
            yield
        finally:
            process.terminate()
            process.join(30)
            process.kill()
            pipe.close()


def started(
    processes: ForkServerContext, target: Callable[..., None], setup: msgspec.Struct
) -> tuple[ForkServerProcess, Connection]:
    """Start a process; its pipe tells when clients can connect."""
    here, there = processes.Pipe(duplex=False)
    process = processes.Process(target=target, args=(setup, there))
    process.start()
    there.close()
    return process, here


async def serving(pipe: Connection) -> None:
    """Wait until the server of a pipe serves.

    Raises:
        EOFError: It has ended before that.
    """
    await anyio.wait_readable(pipe.fileno())
    pipe.recv()


def free_url() -> str:
    """Return a URL where no server listens."""
    return f"tcp://127.0.0.1:{free_port()}"


async def run(folder: Path, seconds: float, clients: int, recovery: str, seed: int) -> Report:
    """Kill a server for so many seconds while so many clients use it, and return what was seen."""
    setup = msgspec.convert(
        {
            "url": free_url(),
            "store": str(folder / "goals.db"),
            "diary": str(folder / "diary"),
            "recovery": recovery,
        },
        Setup,
    )
    ledger, keeper, is_over = Ledger(), Keeper(setup, seed), anyio.Event()
    async with AsyncExitStack() as stack:
        async with anyio.create_task_group() as tasks:
            for number in range(clients):
                tasks.start_soon(Visitor(setup.url, seed + number, ledger).run, is_over)
            await keeper.kill_for(seconds)
            is_over.set()
            # The last one lives until all clients have what they wait for.
            await stack.enter_async_context(keeper.survivor())
        await settle(setup.url, ledger)
    diary = list(entries_of(folder / "diary"))
    rules = Rules(recovery == "rerun", setup.max_attempts)
    return Report(
        kills=keeper.kills.total(),
        kills_before_it_served=keeper.kills["not served"],
        goals=len(ledger.goals),
        calls=dict(ledger.calls),
        ends=dict(ledger.ends()),
        attempts=attempts_of(diary),
        faults=list(faults_of(ledger, diary, rules)),
    )

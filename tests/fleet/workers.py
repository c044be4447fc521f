"""Workers of a fleet as processes, which are killed, frozen and stopped from outside."""

from __future__ import annotations

import os
import signal
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Literal

import anyio
import msgspec

from fibaction import Schedule
from tests.kills.harness import serving, started
from tests.kills.victim import serve_until_stopped

STOP_TIMEOUT = 30.0
"""Seconds for the end of a process in good order; then it is killed."""


class Setup(msgspec.Struct):
    """The settings of one worker."""

    name: str
    url: str
    diary: str
    recovery: Literal["abort", "rerun"]
    at_stop: Literal["abort", "keep"] = "keep"
    limit: int = 0
    """The goals of each key that may run in the whole fleet; 0 for any number."""

    def renamed(self, name: str) -> Setup:
        """Return the settings of another worker, with a diary next to that of this one."""
        url = self.url.replace(f"worker={self.name}", f"worker={name}")
        diary = str(Path(self.diary).with_stem(name))
        return msgspec.structs.replace(self, name=name, url=url, diary=diary)


def schedule_of(limit: int) -> Schedule | None:
    """Return a schedule with a limit for the whole fleet; None for no limit."""
    if not limit:
        return None
    return Schedule(key=lambda work: work.key, concurrency=limit, queue=10_000, fleet_limit="trial")


async def serve_in_fleet(setup: Setup, parent: Connection) -> None:
    """Serve as a worker."""
    await serve_until_stopped(
        setup.url,
        setup.diary,
        parent,
        recovery=setup.recovery,
        at_stop=setup.at_stop,
        max_goals=10_000,
        schedule=schedule_of(setup.limit),
    )


def run_worker(setup: Setup, parent: Connection) -> None:
    """Run a worker in this process."""
    anyio.run(serve_in_fleet, setup, parent)


class WorkerProcess:
    """A worker that serves."""

    def __init__(self, setup: Setup, process: ForkServerProcess) -> None:
        self.setup = setup
        self.name = setup.name
        self.diary = Path(setup.diary)
        self._process = process

    @property
    def is_alive(self) -> bool:
        """True until its process has ended."""
        return self._process.is_alive()

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.join()

    def freeze(self) -> None:
        """Stop it, so that it does nothing until `thaw`."""
        self._signal(signal.SIGSTOP)

    def thaw(self) -> None:
        """Let it go on."""
        self._signal(signal.SIGCONT)

    def _signal(self, number: signal.Signals) -> None:
        assert self._process.pid is not None
        os.kill(self._process.pid, number)

    async def stop(self) -> int | None:
        """Stop it in good order, and return its exit code; None if it had to be killed."""
        self._process.terminate()
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(self._process.join, STOP_TIMEOUT)
        code = self._process.exitcode
        self.kill()
        return code


class Crew(list[WorkerProcess]):
    """Workers that serve, and those that have ended."""

    def __init__(self) -> None:
        super().__init__()
        self._processes = get_context("forkserver")
        self._processes.set_forkserver_preload(["tests.fleet.workers", "fibaction_transports.nats"])
        self._pipes: list[Connection] = []

    async def start(self, *setups: Setup) -> None:
        """Start workers, and wait until clients can find all of them."""
        first = len(self._pipes)
        for setup in setups:
            process, pipe = started(self._processes, run_worker, setup)
            self.append(WorkerProcess(setup, process))
            self._pipes.append(pipe)
        for pipe in self._pipes[first:]:
            await serving(pipe)

    def close(self) -> None:
        """End all of them at once."""
        for one in self:
            one.kill()
        for pipe in self._pipes:
            pipe.close()


@asynccontextmanager
async def workers(*setups: Setup) -> AsyncGenerator[Crew, None]:
    """Run workers while the block lasts; it begins when clients can find all of them."""
    crew = Crew()
    try:
        await crew.start(*setups)
        yield crew
    finally:
        crew.close()

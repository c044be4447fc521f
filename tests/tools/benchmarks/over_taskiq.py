"""taskiq with Redis: a task for each goal, in a stream of Redis, and its result in a key.

The worker acknowledges a task when it has run it. A client finds a result by asking for it again
and again, as taskiq does.

`FIBACTION_BENCH_REDIS` is the URL of a server of Redis, which must be running.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import AsyncGenerator, Iterator
from contextlib import asynccontextmanager, contextmanager
from importlib.util import find_spec
from pathlib import Path
from subprocess import DEVNULL, Popen
from typing import Any

import anyio

from fibaction.cli.verbs.serve import rare_collections
from tests.support.ports import free_port
from tests.tools.benchmarks.contender import Contender

REDIS = "FIBACTION_BENCH_REDIS"
UNPACKED = Path(__file__).parents[3] / ".venv" / "redis" / "usr"
"""The folder to which `make bench` downloads Redis, if it is not installed."""
POLL, POLL_OF_MANY = 0.01, 0.05
"""Seconds between two questions for a result, with one goal at once and with many: the fastest for
each of those that were tried. taskiq's default is 0.2."""
TASKS = 1000
"""Tasks that the worker runs at once."""


def redis_server() -> str | None:
    """Return the path of the server's program."""
    return shutil.which("redis-server") or shutil.which("redis-server", path=f"{UNPACKED}/bin")


def missing(*, is_installed: bool, server: str | None) -> str:
    """Return the reason why taskiq cannot take part; empty if it can."""
    if not is_installed:
        return "it is not installed; `make bench` installs it"
    return "" if server else "there is no redis-server; Debian and Ubuntu have it"


def missing_here() -> str:
    """Return that reason for this environment."""
    return missing(is_installed=find_spec("taskiq_redis") is not None, server=redis_server())


@contextmanager
def redis(folder: Path) -> Iterator[str]:
    """Run a server of Redis that writes each second what has changed, and yield its URL."""
    program = redis_server()
    assert program is not None
    port = free_port()
    command = [program, "--port", str(port), "--bind", "127.0.0.1", "--dir", str(folder)]
    command += ["--appendonly", "yes", "--save", ""]
    libraries = ":".join(str(path) for path in UNPACKED.glob("lib/*-linux-gnu"))
    process = Popen(command, stdout=DEVNULL, env={**os.environ, "LD_LIBRARY_PATH": libraries})
    try:
        yield f"redis://127.0.0.1:{port}"
    finally:
        process.terminate()
        process.wait()


def _task(*, is_worker: bool) -> tuple[Any, Any]:
    """Return the broker and its one task."""
    from taskiq_redis import RedisAsyncResultBackend, RedisStreamBroker

    url = os.environ[REDIS]
    backend: Any = RedisAsyncResultBackend(url, result_ex_time=10)
    broker = RedisStreamBroker(url, xread_block=100).with_result_backend(backend)
    broker.is_worker_process = is_worker

    @broker.task(task_name="count")  # type: ignore[untyped-decorator, unused-ignore]  # not installed for checks
    async def count(number: int) -> int:
        return number

    return broker, count


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    from taskiq.api import run_receiver_task

    broker, _ = _task(is_worker=True)
    await broker.startup()
    with rare_collections():
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(lambda: run_receiver_task(broker, max_async_tasks=TASKS))
            yield os.environ[REDIS]
            tasks.cancel_scope.cancel()
    await broker.shutdown()


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    broker, count = _task(is_worker=False)
    await broker.startup()
    yield OverTaskiq(count)
    await broker.shutdown()


class OverTaskiq(Contender):
    def __init__(self, task: Any) -> None:
        self._task = task
        self._poll = POLL

    async def at_once(self, times: int, width: int) -> None:
        self._poll = POLL_OF_MANY
        await super().at_once(times, width)
        self._poll = POLL

    async def goal(self) -> None:
        sent = await self._task.kiq(0)
        result = await sent.wait_result(check_interval=self._poll, timeout=60)
        assert result.return_value == 0

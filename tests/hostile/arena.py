"""The arena: a server with a meter, an honest client, and an attack on the server beside it."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import AsyncGenerator, Callable, Generator, Sequence
from contextlib import AbstractContextManager, ExitStack, asynccontextmanager, contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from statistics import median
from time import monotonic, perf_counter
from typing import Any, NamedTuple

import anyio
import anyio.lowlevel
from anyio import to_thread

from fibaction import ActionClient, connect
from tests.hostile import victim
from tests.hostile.attack import Attack
from tests.hostile.attacks import ATTACKS
from tests.hostile.meter import Reading
from tests.hostile.raw_client import Lost, Target, until
from tests.hostile.victim import Settings
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result

ROOT = Path(__file__).resolve().parents[2]
PATIENCE = 40.0
"""Seconds for one attack in its short form: many times what the slowest takes."""
HONEST_GOALS = 20
"""Goals of the honest client during an attack, at least."""
WEB = ("fibaction_transports.web", "fibaction_transports.web.http_transport")
SHUTDOWN = 0.5 + 2
"""Seconds in which SIGTERM ends the server: its `shutdown_timeout`, and two more."""

Honest = ActionClient[Goal, Feedback, Result]


class Server:
    """A server in a process of its own."""

    def __init__(
        self, process: ForkServerProcess, told: Any, orders: Connection, log: Path
    ) -> None:
        self.told = told
        """The first message of the process: the addresses at which it serves."""
        self._process = process
        self._orders = orders
        self._log = log

    @property
    def url(self) -> str:
        return str(self.told[0])

    @property
    def web(self) -> str:
        return str(self.told[1])

    @property
    def log(self) -> str:
        """The log so far, with its line ends as they are."""
        return self._log.read_bytes().decode(errors="surrogateescape")

    async def reset(self) -> Reading:
        """Set the figures of the meter to zero, and return them."""
        return await self._order("reset")

    async def read(self) -> Reading:
        """Return what the meter says."""
        return await self._order("read")

    async def _order(self, order: str) -> Reading:
        def ask() -> Reading:
            self._orders.send(order)
            reading: Reading = self._orders.recv()
            return reading

        try:
            return await to_thread.run_sync(ask)
        except (EOFError, OSError):
            raise AssertionError(f"the server has ended: {self.log[-2000:]}") from None

    async def stop(self, within: float) -> tuple[float, int | None]:
        """Send SIGTERM; return the seconds until the process has ended, and its exit code: None if
        it has not ended `within` so many.

        The time in which the process waited for a processor does not count.
        """
        begun, idle = monotonic(), self._waited()
        self._process.terminate()
        waited = 0.0
        with anyio.move_on_after(2 * within):
            while self._process.is_alive() and monotonic() - begun - waited < within:
                waited = max(waited, self._waited() - idle)
                await anyio.sleep(0.01)
        return monotonic() - begun - waited, self._process.exitcode

    @property
    def cpu(self) -> float:
        """The seconds of the processor that the server has used."""
        return self._scheduled(0)

    def _waited(self) -> float:
        """Return the seconds in which the process was ready to run, and others ran."""
        return self._scheduled(1)

    def _scheduled(self, field: int) -> float:
        try:
            fields = Path(f"/proc/{self._process.pid}/schedstat").read_text().split()
        except OSError:  # it has ended
            return 0.0
        return int(fields[field]) / 1e9 if fields else 0.0


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": os.pathsep.join([".", "transports"])}


def started(settings: Settings) -> AbstractContextManager[Server]:
    """Start a server; it ends with the block, at the latest."""
    return started_by(victim.run, settings, preload=["fibaction_transports.tcp", *WEB])


PROCESSES = get_context("forkserver")


@contextmanager
def started_by(
    run: Callable[..., None], *arguments: Any, preload: Sequence[str] = ()
) -> Generator[Server, None, None]:
    """Start a process that a meter measures; it ends with the block, at the latest.

    It is forked from a process that has imported everything, because the imports cost more than
    most attacks.
    """
    PROCESSES.set_forkserver_preload([run.__module__, *preload, "pytest"])
    here, there = PROCESSES.Pipe()
    orders, of_meter = PROCESSES.Pipe()
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log.txt"
        log.touch()
        process = PROCESSES.Process(
            target=run, args=(there, of_meter, str(log), *arguments), daemon=True
        )
        process.start()
        try:
            there.close()
            of_meter.close()
            try:
                told = here.recv()
            except EOFError:
                raise AssertionError(f"it has not started: {log.read_text()[-2000:]}") from None
            yield Server(process, told, orders, log)
        finally:
            process.kill()
            process.join()
            here.close()
            orders.close()


@contextmanager
def attacked(name: str, server: Server, token: str) -> Generator[None, None, None]:
    """Attack in a process of its own, which ends with the block."""
    command = [sys.executable, "-m", "tests.hostile.attacker", name]
    command += [server.url, server.web, token]
    with subprocess.Popen(
        command, cwd=ROOT, env=environment(), stdin=subprocess.PIPE, stdout=subprocess.DEVNULL
    ) as process:
        try:
            yield
        finally:
            process.kill()


class Figures(NamedTuple):
    """The costs of one attack."""

    reading: Reading
    above: float
    """MiB of memory at the peak, above those before the attack."""
    latencies: list[float]
    """Seconds of each goal of the honest client, in order of length."""
    work: list[float]
    """Seconds of the processor that the server has used from the sending of each of these goals to
    its end, in order of length: the latency on a machine that does nothing else, or more."""
    quiet: float
    """The median of this work before the attack."""
    stopped: float
    """Seconds from SIGTERM to the end of the server."""
    code: int | None
    """The exit code of the server; None if it had to be killed."""
    log: str = ""
    attacked: int = 0
    """Bytes that the attacker has sent, in datagrams; 0 if it was another process."""
    sent: int = 0
    """Bytes that the victim of datagrams has sent, but those for the honest peer's questions."""

    def latency(self, quantile: float) -> float:
        """Return the latency that this part of the goals did not exceed."""
        return _quantile(self.latencies, quantile)

    def work_of(self, quantile: float) -> float:
        """Return the work of the server that this part of the goals did not exceed."""
        return _quantile(self.work, quantile)


def _quantile(values: list[float], quantile: float) -> float:
    return values[min(len(values) - 1, int(len(values) * quantile))]


async def be_honest(
    client: Honest, server: Server, latencies: list[float], work: list[float]
) -> None:
    """Send goals one after another, and check that each ends rightly."""
    while True:
        begun, used = perf_counter(), server.cpu
        result = await client.call(Goal(5))
        latencies.append(perf_counter() - begun)
        work.append(server.cpu - used)
        assert result.sequence == [0, 1, 1, 2, 3, 5]
        await anyio.sleep(0.002)


async def repeat(attack: Attack, target: Target, waves: list[float]) -> None:
    """Attack again and again; a server that closes a connection ends the wave only.

    The short form pauses between waves, since it has to end soon on a busy machine, too.
    """
    while True:
        try:
            await attack.wave(target)
        except* Lost:
            pass
        waves.append(monotonic())
        await anyio.sleep(0 if target.is_long else 0.2)


@asynccontextmanager
async def honest_client(server: Server, settings: Settings) -> AsyncGenerator[Honest, None]:
    """Connect the honest client; a connection that is lost is an error of its goals."""
    given: Any = {"heartbeat": 15.0, "reconnect": False}
    if "tokens" in settings.wire:
        given["token"] = "honest"
    async with connect(server.url, FIBONACCI, **given) as client:
        yield client


async def figures_of(name: str, seconds: float = 0.0) -> Figures:
    """Attack a server, and end it during the attack.

    The short form, of no seconds, is one wave of this process; the long form has a process.
    """
    attack = ATTACKS[name]
    settings = attack.settings
    token = "hostile" if "tokens" in settings.wire else ""
    latencies: list[float] = []
    work: list[float] = []
    waves: list[float] = []
    with started(settings) as server, ExitStack() as stack:
        with anyio.fail_after(PATIENCE + 4 * seconds):
            async with anyio.create_task_group() as attacking:
                async with honest_client(server, settings) as client:
                    async with anyio.create_task_group() as honest:
                        honest.start_soon(be_honest, client, server, latencies, work)
                        await until(lambda: len(latencies) >= 5)
                        idle, quiet = (await server.reset()).memory, median(work)
                        latencies.clear()
                        work.clear()
                        if seconds:
                            stack.enter_context(attacked(name, server, token))
                            await anyio.sleep(seconds)
                        else:
                            target = Target(server.url, token, web=server.web)
                            attacking.start_soon(repeat, attack, target, waves)
                            await until(lambda: len(waves) > 0)
                        await until(lambda: len(latencies) >= HONEST_GOALS)
                        honest.cancel_scope.cancel()
                reading = await server.read()
                stopped, code = await server.stop(SHUTDOWN + 10)
                attacking.cancel_scope.cancel()
        above = (reading.peak - idle) / 2**20
        times = sorted(latencies), sorted(work), quiet, stopped
        return Figures(reading, above, *times, code, server.log)

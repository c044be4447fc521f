"""The costs of a store: servers with one beside a server without.

    python -m tests.tools.benchmarks.durable [--rounds N] [--folder FOLDER] [--rates KIND]

A server without a store, one with `sync="full"` and one with `sync="normal"` do the same goals in
turns, so that other programs disturb all of them. Between the servers, the disk alone makes small
writes durable, one after another: the rate of its own. With `--rates tcp` or `--rates inproc`, only
the rates over this transport are measured.

Garbage is collected as rarely as `fibaction serve` does it: goals that wait for the disk are alive
for many turns, and Python's default would look at them again and again.

The folder must be on the disk that is to be measured: /tmp is often in memory.
"""

from __future__ import annotations

import argparse
import gc
import os
import tempfile
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from statistics import median
from time import perf_counter, process_time
from typing import Literal, TypeAlias

import anyio

from fibaction import Action, ActionServer, GoalHandle, SqliteStore, serve
from fibaction import connect as connect_to
from fibaction.border.goal_store import GoalStore
from fibaction.cli.verbs.serve import rare_collections

WORK = Action("work", goal=int, feedback=int, result=str)
GOALS = {1: 200, 100: 5000, 500: 5000}
"""The number of goals of a round, by the number of goals at once."""
KINDS = ("inproc", "tcp")
"""The transports over which rates are measured."""
RECORD = bytes(200)
"""Bytes of a write that is measured beside one goal at a time."""

Call: TypeAlias = Callable[[int], Awaitable[object]]
"""A function that does one piece of work, by its number."""


async def work(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    yield f"done {goal.request}"


@asynccontextmanager
async def served(url: str, store: GoalStore | None) -> AsyncIterator[Call]:
    """Serve at the URL, and yield a call of the action."""
    server = ActionServer(WORK, work, store=store, max_results=1000)
    async with serve(server, url) as (there,), connect_to(there, WORK) as client:
        yield client.call


async def rounds_of(call: Call, at_once: int, times: int) -> tuple[float, float]:
    """Do the work so many times; return seconds, and seconds of the processor, of each."""

    async def some(first: int) -> None:
        for number in range(first, times, at_once):
            await call(number)

    gc.collect()
    began, began_cpu = perf_counter(), process_time()
    async with anyio.create_task_group() as tasks:
        for first in range(at_once):
            tasks.start_soon(some, first)
    return (perf_counter() - began) / times, (process_time() - began_cpu) / times


async def rates(kind: str, folder: Path, rounds: int) -> None:
    """Print the goals in a second of each server, and their ratio to the one without a store."""
    async with AsyncExitStack() as stack:
        calls: dict[str, Call] = {}
        syncs: tuple[Literal["full", "normal"] | None, ...] = (None, "full", "normal")
        for sync in syncs:
            url = f"inproc://{sync}" if kind == "inproc" else "tcp://127.0.0.1:0"
            store = sync and SqliteStore(folder / f"{kind}-{sync}.db", sync)
            calls[sync or "memory"] = await stack.enter_async_context(served(url, store))
        for at_once, times in GOALS.items():
            found: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
            disk: list[float] = []
            for number in range(rounds + 1):
                for name, call in calls.items():
                    taken = await rounds_of(call, at_once, times)
                    if number:  # the first round fills caches
                        found[name].append(taken)
                disk.append(sync_seconds(folder / "disk", 20))
            _print_rates(kind, at_once, found, disk)


def _print_rates(
    kind: str, at_once: int, found: dict[str, list[tuple[float, float]]], disk: list[float]
) -> None:
    base = found["memory"]
    for name, taken in found.items():
        ratios = sorted(one[0] / other[0] for one, other in zip(base, taken, strict=True))
        cpu = median(other[1] - one[1] for one, other in zip(base, taken, strict=True)) * 1e6
        text = (
            f"{kind}, {at_once:3} at once, {name:6}: {1 / median(one[0] for one in taken):6.0f}/s,"
            f" {median(ratios):.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f}) of the rate in memory,"
            f" processor {median(one[1] for one in taken) * 1e6:.0f} us each, {cpu:+.0f}"
        )
        if at_once == 1:
            more = median(other[0] - one[0] for one, other in zip(base, taken, strict=True))
            text += f"; {more * 1e3:+.2f} ms, one fdatasync takes {median(disk) * 1e3:.2f} ms"
        print(text, flush=True)
    syncs = sorted(1 / seconds for seconds in disk)
    print(
        f"{kind}, {at_once:3} at once, disk  : {median(syncs):6.0f} fdatasync/s, one after another"
        f" ({syncs[0]:.0f} to {syncs[-1]:.0f})",
        flush=True,
    )


def sync_seconds(path: Path, times: int) -> float:
    """Return the seconds of one write that is durable, without a database."""
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    try:
        began = perf_counter()
        for _ in range(times):
            os.write(file, RECORD)
            os.fdatasync(file)
        return (perf_counter() - began) / times
    finally:
        os.close(file)


async def measure(rounds: int, folder: Path, only: str | None) -> None:
    for kind in KINDS if only is None else (only,):
        await rates(kind, folder, rounds)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.tools.benchmarks.durable")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--folder", type=Path, default=Path())
    parser.add_argument("--rates", choices=KINDS, help="measure only the rates over this")
    arguments = parser.parse_args()
    with rare_collections(), tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        anyio.run(measure, arguments.rounds, Path(folder), arguments.rates)


if __name__ == "__main__":
    main()

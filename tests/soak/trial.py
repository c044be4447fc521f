"""One soak: its two processes, the load beside them, and the report of what they used."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import anyio

from tests.soak.ends import CONNECTIONS
from tests.support.json_program import Program, processor_of, program
from tests.support.ros_domain import own_domain
from tests.tools.benchmarks.suite import machine

SAMPLES = 120
"""The samples of a soak, at equal distances in time."""
USED = ("memory", "tasks", "files", "threads")
"""What is looked at, of each of the two processes."""
COUNTED = USED[1:]
GROWTH = 1.1
"""The factor by which memory may grow because of the allocator's fragmentation."""
TYPES = Path(__file__).parents[2] / "examples/ros2"
"""The types of the goals over DDS."""
BUSY = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: pass"
"""A program that keeps a processor busy while its parent lives."""


class Soak(NamedTuple):
    """What one soak is to be."""

    seconds: float
    over: str = "tcp"
    load: int = 0
    """The busy processes beside it."""

    @property
    def name(self) -> str:
        return "soak_beside_load" if self.load else "soak"

    @property
    def command(self) -> str:
        """The command that gives this report, without what is the default."""
        words = ["python -m tests.soak"]
        words += [f"--seconds {self.seconds:g}"] * (self.seconds != 600)
        words += [f"--over {self.over}"] * (self.over != "tcp")
        words += [f"--load {self.load}"] * (self.load > 0)
        return " ".join([*words, "--keep"])


@contextmanager
def busy(count: int) -> Iterator[list[int]]:
    """Keep so many processes busy until the block ends; give their IDs."""
    processes = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(count)]
    try:
        yield [process.pid for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.wait()


async def run(soak: Soak, *, count: int = SAMPLES) -> dict[str, Any]:
    """Run a soak, and return its report; tell how it goes ten times meanwhile."""
    about = {
        "name": soak.name,
        "command": soak.command,
        "date": datetime.now(UTC).date().isoformat(),
        "machine": machine(),
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("fibaction", "anyio", "msgspec")},
        },
        "connections": CONNECTIONS[soak.over],
        **soak._asdict(),
    }
    url = "dds://soak" if soak.over == "dds" else f"{soak.over}://127.0.0.1:0"
    with busy(soak.load) as loaders, own_domain() as patch:
        patch.setenv("FIBACTION_SEARCH", str(TYPES))
        async with program(sys.executable, "-m", "tests.soak.ends", "server", url) as server:
            before = {"server": await server.ask("begin")}
            address = await server.line()
            arguments = ("-m", "tests.soak.ends", "client", address)
            async with program(sys.executable, *arguments) as client:
                before["client"] = await client.ask("begin")
                ends = {"server": server, "client": client}
                began = _processors(loaders)
                samples = await _samples(ends, soak.seconds, count)
                passed, others = (
                    now - then for now, then in zip(_processors(loaders), began, strict=True)
                )
                after = {"client": await client.ask("end")}
            after["server"] = await server.ask("end")
    used = sum(samples[end]["seconds"][-1] - before[end]["seconds"] for end in ends)
    return {
        **about,
        "others_share": round(max(0.0, others - used) / passed, 3),
        "goals": sum(after["client"]["ends"].values()),
        "ends": after["client"].pop("ends"),
        "before": before,
        "after": after,
        "at": samples["at"],
        **{end: {what: samples[end][what] for what in USED} for end in ends},
    }


async def _samples(ends: dict[str, Program], seconds: float, count: int) -> dict[str, Any]:
    samples: dict[str, Any] = {"at": [], **{end: {} for end in ends}}
    start = anyio.current_time()
    for number in range(1, count + 1):
        await anyio.sleep_until(start + number * seconds / count)
        samples["at"].append(round(anyio.current_time() - start, 2))
        for end, process in ends.items():
            for what, value in (await process.ask("state")).items():
                samples[end].setdefault(what, []).append(value)
        if number % (count // 10) == 0:
            told = {end: {what: samples[end][what][-1] for what in USED} for end in ends}
            goals = samples["client"]["goals"][-1]
            print(f"{samples['at'][-1]:4.0f} s: {goals:,} goals, {told}", flush=True)
    return samples


def _processors(loaders: list[int]) -> tuple[float, float]:
    """Return the seconds of all processors so far: all, and those that others were busy with."""
    ticks = os.sysconf("SC_CLK_TCK")
    numbers = [int(one) for one in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
    idle = numbers[3] + numbers[4]
    own = sum(map(processor_of, loaders)) * ticks
    return sum(numbers) / ticks, (sum(numbers) - idle - own) / ticks


def faults(report: dict[str, Any]) -> list[str]:
    """Return what has grown, or was left."""
    found = []
    if not report["ends"]:
        found.append("no goal has ended")
    for end in ("server", "client"):
        warm, last = growth(report[end]["memory"])
        if last > warm * GROWTH:
            found.append(f"the memory of the {end} has grown from {warm:,} to {last:,} bytes")
        for what in COUNTED:
            before, after = report["before"][end][what], report["after"][end][what]
            if after > before:
                found.append(f"the {end} has {after} {what} at the end, and had {before} before")
    return found


def growth(values: list[int]) -> tuple[int, int]:
    """Return the medians of the second and of the last tenth."""
    tenth = len(values) // 10
    return round(median(values[tenth : 2 * tenth])), round(median(values[-tenth:]))

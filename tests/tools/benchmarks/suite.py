"""`make bench`: everything, beside its peers, as JSON, pictures, and the tables of a page."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from contextlib import AsyncExitStack, aclosing
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import Any

from tests.support.json_program import ROOT
from tests.tools.benchmarks import memory, pages, pictures, rounds, starting
from tests.tools.benchmarks.ways import (
    ROS,
    WAYS,
    Pair,
    Way,
    left_out,
    ros_environment,
    started,
    versions,
)

FOLDER = ROOT / "docs" / "benchmarks"

RUNNING: dict[str, Callable[[Mapping[str, Pair], float], Awaitable[dict[str, Any]]]] = {
    "goals": lambda running, scale: rounds.rates(running, "goals", scale),
    "feedback": lambda running, scale: rounds.rates(running, "feedback", scale),
    "goal_latency": rounds.goal_latencies,
    "feedback_latency": rounds.feedback_latencies,
    # Last, because it changes the state of rclpy.
    "goals_at_once": lambda running, scale: rounds.rates(running, "batches", scale),
}
"""The comparisons for which all ways run at the same time."""


async def measure(scale: float) -> AsyncGenerator[dict[str, Any], None]:
    """Measure all comparisons, and return the report of each."""
    without = left_out()
    for key, reason in without.items():
        print(f"left out is {WAYS[key].label}: {reason}", flush=True)
    about: dict[str, Any] = {
        "date": datetime.now(UTC).date().isoformat(),
        "command": "make bench" if scale == 1 else f"make bench SCALE={scale:g}",
        "machine": machine(),
    }
    async with AsyncExitStack() as stack:
        running = await start_all(stack, WAYS, without)
        about["versions"] = {"python": platform.python_version(), **versions(without)}
        about["left_out"] = {WAYS[key].label: reason for key, reason in without.items()}
        for name, compare in RUNNING.items():
            found = await compare(running, scale)
            for key, values in found["ways"].items():
                way = WAYS[key]
                values |= {"label": way.label, "group": way.group, "ours": way.is_ours}
            yield {"comparison": name, **about, **found}
    found = await memory.measure(without, scale)
    about["left_out"] = {WAYS[key].label: reason for key, reason in without.items()}
    yield {"comparison": "memory", **about, **found}
    yield {"comparison": "start", **about, **starting.start(without, scale)}


async def start_all(
    stack: AsyncExitStack, ways: Mapping[str, Way], without: dict[str, str]
) -> dict[str, Pair]:
    """Start the ways that are available. A peer that does not start is left out, too."""
    running: dict[str, Pair] = {}
    environment = await stack.enter_async_context(ros_environment())
    for key, way in ways.items():
        if key in without:
            continue
        try:
            running[key] = await stack.enter_async_context(
                started(way, environment if way.group == ROS else None)
            )
        except RuntimeError as exc:
            if way.is_ours:
                raise
            without[key] = f"it did not start ({exc})"
            print(f"left out is {way.label}: {without[key]}", flush=True)
    return running


def machine() -> dict[str, Any]:
    """Return a description of the machine, and of its load."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "memory_gigabytes": round(memory / 1e9),
        "system": f"{platform.system()} on {platform.machine()}",
        "load_at_start": round(os.getloadavg()[0], 1),
    }


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or "unknown"


async def run(scale: float) -> None:
    """Measure, and write the reports, the pictures and the tables."""
    FOLDER.mkdir(exist_ok=True)
    start = perf_counter()
    async with aclosing(measure(scale)) as reports:
        async for report in reports:
            path = FOLDER / f"{report['comparison']}.json"
            path.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
            print(f"{perf_counter() - start:4.0f} s: {path.relative_to(ROOT)}", flush=True)
    write()
    print("docs/comparisons.md, and the pictures, are up to date")


def read() -> dict[str, dict[str, Any]]:
    """Return the reports that exist, by name."""
    return {
        path.stem: json.loads(path.read_text(encoding="utf-8"))
        for path in sorted(FOLDER.glob("*.json"))
    }


def write() -> None:
    """Make the pictures and the tables of the page from the reports."""
    reports = read()
    for name, report in reports.items():
        (FOLDER / f"{name}.svg").write_text(pictures.picture(report), encoding="utf-8")
    page = pages.PAGE.read_text(encoding="utf-8")
    pages.PAGE.write_text(pages.with_tables(page, reports), encoding="utf-8")

"""fibaction under each version of Python, beside that of the benchmarks.

    python -m tests.tools.benchmarks.pythons [--rounds N] [--write]

The other versions are those whose environments `make test-pythons` or `make bench` has made, below
`build`. Each runs server and client together in a process of its own, with the same libraries. They
work in turns, in short rounds, and it is the processor's time that counts, so that other programs
disturb little. `--write` puts the table into docs/comparisons.md.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from contextlib import AsyncExitStack
from pathlib import Path
from statistics import median, quantiles

import anyio

from tests.support.page_parts import with_part
from tests.tools.benchmarks.pages import PAGE
from tests.tools.benchmarks.program import ROOT, Program, program
from tests.tools.benchmarks.versions import ORDERS, WARM_UP, paths, round_of

PART = ("pythons", "python -m tests.tools.benchmarks.pythons")
"""The part of the page with the table, and the command that makes it."""
NAMES = {"goals": "one after another", "batches": "500 at once", "feedback": "feedback"}
ABOUT = (
    "import json, platform; from importlib.metadata import version;"
    "print(json.dumps([platform.python_version(), version('anyio'), version('msgspec')]))"
)

Ratios = dict[str, dict[str, list[float]]]
"""For each order, and each other version, the ratios of its rate to the first version's."""


def found(folder: Path) -> dict[str, Path]:
    """Return this Python, and those of the environments, by their versions.

    Raises:
        SystemExit: An environment has other versions of the libraries.
    """
    others = sorted(folder.glob("python3.*/bin/python"), key=lambda one: int(_minor(one)))
    known: dict[str, Path] = {}
    libraries: list[str] = []
    for python in (Path(sys.executable), *others):
        told = subprocess.run([python, "-c", ABOUT], capture_output=True, text=True, check=True)
        version, *versions = json.loads(told.stdout)
        libraries = libraries or versions
        if versions != libraries:
            raise SystemExit(
                f"{python} has anyio and msgspec {versions}, and {sys.executable} {libraries}:"
                f" remove {python.parents[1]}, and make it again"
            )
        known.setdefault(version, python)
    return known


def _minor(python: Path) -> str:
    return python.parents[1].name.partition(".")[2]


async def compare(pythons: dict[str, Path], rounds: int) -> Ratios:
    """Run all versions in turns, and return their ratios to the first of them, of all rounds."""
    child = str(Path(__file__).with_name("version_child.py"))
    first, *others = pythons
    ratios: Ratios = {order: {version: [] for version in others} for order in ORDERS}
    async with AsyncExitStack() as stack:
        running: dict[str, Program] = {}
        for version, python in pythons.items():
            running[version] = await stack.enter_async_context(
                program(python, "-P", child, environment={"PYTHONPATH": paths(ROOT)})
            )
            await running[version].line()
        for number in range(rounds + WARM_UP):
            for order in ORDERS:
                seconds = dict.fromkeys(pythons, 0.0)
                for version in (*pythons, *reversed(pythons)):  # none gains by its place
                    seconds[version] += await round_of(running[version], order)
                for version in others if number >= WARM_UP else ():
                    ratios[order][version].append(seconds[first] / seconds[version])
    return ratios


def table(ratios: Ratios, first: str) -> str:
    """Return the ratios as a table for the page."""
    others = list(next(iter(ratios.values())))
    heads = [f"| Rate, to that with {first} (more than 1: faster)", *others]
    lines = [f"{' | '.join(heads)} |", f"| --- |{' ---: |' * len(others)}"]
    for order, of_versions in ratios.items():
        where, _, work = order.partition(" ")
        cells = [f"| fibaction, {where}: {NAMES[work]}"]
        for each in of_versions.values():
            low, _, high = quantiles(each, n=4)
            cells.append(f"{median(each):.2f} ({low:.2f} to {high:.2f})")
        lines.append(f"{' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Print the table, or write it."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.benchmarks.pythons")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    pythons = found(ROOT / "build")
    if len(pythons) == 1:
        print("no other Python is compared: `make test-pythons` makes their environments")
        return
    made = table(anyio.run(compare, pythons, arguments.rounds), next(iter(pythons)))
    print(made)
    if arguments.write:
        page = PAGE.read_text(encoding="utf-8")
        PAGE.write_text(with_part(page, *PART, made), encoding="utf-8")


if __name__ == "__main__":
    main()

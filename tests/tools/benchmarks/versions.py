"""This version of fibaction beside another one, for example the one before a change.

    git worktree add ../before COMMIT
    python -m tests.tools.benchmarks.versions ../before [--rounds N] [--starts N] [--only ORDER]

Each version runs in a process of its own, server and client together. They work in turns, in short
rounds, and it is the processor's time that counts, so that other programs disturb little. A process
may be lucky with its memory, so there are several of each, one after another.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from statistics import quantiles

import anyio

from tests.tools.benchmarks.program import ROOT, Program, program

WORK = {"goals": 800, "batches": 2, "feedback": 5000}
"""The work of each version in a round, and the number of times."""
ORDERS = [f"{where} {work}" for where in ("inproc", "tcp") for work in WORK]
WARM_UP = 5
"""First rounds of a process, which are not counted."""


def paths(root: Path) -> str:
    """Return the `PYTHONPATH` of a version."""
    return os.pathsep.join(map(str, (root, root / "transports")))


async def round_of(version: Program, order: str) -> float:
    """Return the seconds that a version takes for one round of an order."""
    seconds: float = await version.ask(order, WORK[order.split()[1]])
    return seconds


async def compare(other: Path, rounds: int, orders: list[str]) -> dict[str, list[float]]:
    """Start both versions, and return for each order the ratios of this one's rate to the other's,
    of all rounds.
    """
    child = str(Path(__file__).with_name("version_child.py"))
    ratios: dict[str, list[float]] = {order: [] for order in orders}
    async with (
        program(sys.executable, "-P", child, environment={"PYTHONPATH": paths(ROOT)}) as new,
        program(sys.executable, "-P", child, environment={"PYTHONPATH": paths(other)}) as old,
    ):
        for version, root in ((new, ROOT), (old, other)):
            found = Path(await version.line())
            assert found.is_relative_to(root), f"it imports {found}"
        for number in range(rounds + WARM_UP):
            for order in orders:
                # Both orders of the two, so that neither gains by being the second.
                seconds = {new: 0.0, old: 0.0}
                for version in (new, old, old, new):
                    seconds[version] += await round_of(version, order)
                if number >= WARM_UP:
                    ratios[order].append(seconds[old] / seconds[new])
    return ratios


async def run(other: Path, rounds: int, starts: int, orders: list[str]) -> None:
    """Print the ratios of all starts together, and the median of each start."""
    ratios: dict[str, list[list[float]]] = {order: [] for order in orders}
    for _ in range(starts):
        for order, found in (await compare(other, rounds, orders)).items():
            ratios[order].append(found)
    print("Rate of this version to the other's (more than 1: faster)")
    for order, of_starts in ratios.items():
        low, middle, high = quantiles([one for found in of_starts for one in found], n=4)
        medians = " ".join(f"{quantiles(found, n=4)[1]:.3f}" for found in of_starts)
        print(f"{order:16} {middle:.3f} (half of them {low:.3f} to {high:.3f}; starts: {medians})")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.tools.benchmarks.versions")
    parser.add_argument("other", type=Path, help="the folder of the other version")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--starts", type=int, default=4)
    parser.add_argument("--only", choices=ORDERS, help="an order, in place of all")
    arguments = parser.parse_args()
    orders = [arguments.only] if arguments.only else ORDERS
    anyio.run(run, arguments.other.resolve(), arguments.rounds, arguments.starts, orders)


if __name__ == "__main__":
    main()

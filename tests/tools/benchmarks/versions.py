"""This version of fibaction beside another one, for example the one before a change.

    git worktree add ../before COMMIT
    python -m tests.tools.benchmarks.versions ../before [--rounds N] [--starts N] [--only ORDER]
        [--uvloop]

Each version runs in a process of its own, server and client together. They work in turns, in short
rounds, and it is the processor's time that counts, so that other programs disturb little. A process
may be lucky with its memory, so there are several of each, one after another.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import AsyncExitStack
from pathlib import Path
from statistics import quantiles
from typing import NamedTuple

import anyio

from tests.support.json_program import ROOT, Program, program

WORK = {"goals": 800, "batches": 2, "feedback": 5000}
"""The work of each version in a round, and the number of times."""
ORDERS = [f"{where} {work}" for where in ("inproc", "tcp") for work in WORK]
WARM_UP = 5
"""First rounds of a process, which are not counted."""


class Version(NamedTuple):
    """A version of fibaction, and the Python that runs it."""

    root: Path = ROOT
    python: Path = Path(sys.executable)
    options: tuple[str, ...] = ()
    """The options of `version_child`."""


async def compare(
    versions: Mapping[str, Version], rounds: int, orders: Sequence[str] = ORDERS
) -> dict[str, dict[str, list[float]]]:
    """Run all versions in turns, and return for each order, and each version but the first, the
    ratios of its rate to that of the first, of all rounds.
    """
    child = str(Path(__file__).with_name("version_child.py"))
    first, *others = versions
    ratios: dict[str, dict[str, list[float]]] = {
        order: {name: [] for name in others} for order in orders
    }
    async with AsyncExitStack() as stack:
        running: dict[str, Program] = {}
        for name, (root, python, options) in versions.items():
            paths = os.pathsep.join(map(str, (root, root / "transports")))
            running[name] = await stack.enter_async_context(
                program(python, "-P", child, *options, environment={"PYTHONPATH": paths})
            )
            found = Path(await running[name].line())
            assert found.is_relative_to(root), f"it imports {found}"
        for number in range(rounds + WARM_UP):
            for order in orders:
                seconds = dict.fromkeys(versions, 0.0)
                for name in (*versions, *reversed([*versions])):  # none gains by its place
                    seconds[name] += await running[name].ask(order, WORK[order.split()[1]])
                for name in others if number >= WARM_UP else ():
                    ratios[order][name].append(seconds[first] / seconds[name])
    return ratios


async def beside(
    other: Path, rounds: int, starts: int, orders: Sequence[str], *, uvloop: bool = False
) -> dict[str, list[list[float]]]:
    """Return for each order the ratios of this version's rate to another's, of each start."""
    options = ("--uvloop",) if uvloop else ()
    pair = {"other": Version(other, options=options), "this": Version(options=options)}
    ratios: dict[str, list[list[float]]] = {order: [] for order in orders}
    for _ in range(starts):
        found = await compare(pair, rounds, orders)
        for order, of_versions in found.items():
            ratios[order].append(of_versions["this"])
    return ratios


async def run(
    other: Path, rounds: int, starts: int, orders: list[str], uvloop: bool = False
) -> None:
    """Print the ratios of all starts together, and the median of each start."""
    ratios = await beside(other, rounds, starts, orders, uvloop=uvloop)
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
    parser.add_argument("--uvloop", action="store_true", help="run both on uvloop")
    arguments = parser.parse_args()
    orders = [arguments.only] if arguments.only else ORDERS
    other = arguments.other.resolve()
    anyio.run(run, other, arguments.rounds, arguments.starts, orders, arguments.uvloop)


if __name__ == "__main__":
    main()

"""fibaction under each version of Python, beside that of the benchmarks.

    python -m tests.tools.benchmarks.pythons [--rounds N] [--write]

The other versions are those whose environments `make test-pythons` or `make bench` has made, below
`build`. Each runs server and client together in a process of its own, with the same libraries. They
work in turns, in short rounds, and it is the processor's time that counts, so that other programs
disturb little. `--write` puts the table into docs/comparisons.md.
"""

from __future__ import annotations

import json
import subprocess
import sys
from functools import partial
from pathlib import Path
from statistics import median, quantiles

from tests.support.json_program import ROOT
from tests.support.page_parts import markdown_table
from tests.tools.benchmarks.pages import run
from tests.tools.benchmarks.versions import Version, compare

NAMES = {"goals": "one after another", "batches": "500 at once", "feedback": "feedback"}
ABOUT = (
    "import json, platform; from importlib.metadata import version;"
    "print(json.dumps([platform.python_version(), version('anyio'), version('msgspec')]))"
)


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


def table(ratios: dict[str, dict[str, list[float]]], first: str) -> str:
    """Return the ratios as a table for the page."""
    rows: list[list[str]] = []
    for order, of_versions in ratios.items():
        where, _, work = order.partition(" ")
        cells = [f"fibaction, {where}: {NAMES[work]}"]
        for each in of_versions.values():
            low, _, high = quantiles(each, n=4)
            cells.append(f"{median(each):.2f} ({low:.2f} to {high:.2f})")
        rows.append(cells)
    others = next(iter(ratios.values()))
    return markdown_table([f"Rate, to that with {first} (more than 1: faster)", *others], rows)


async def measure(pythons: dict[str, Path], rounds: int) -> str:
    """Return the table for the page."""
    versions = {name: Version(python=python) for name, python in pythons.items()}
    return table(await compare(versions, rounds), next(iter(pythons)))


def main() -> None:
    """Print the table, or write it."""
    pythons = found(ROOT / "build")
    if len(pythons) == 1:
        print("no other Python is compared: `make test-pythons` makes their environments")
    else:
        run("pythons", partial(measure, pythons), rounds=30)


if __name__ == "__main__":
    main()

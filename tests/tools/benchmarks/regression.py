"""The speed of this commit beside that of the last landing.

    python -m tests.tools.benchmarks.regression [--base COMMIT] [--most 0.15]

Without a base, it is the newest commit of this branch that is a day old, so that each night
compares what has landed since the night before. Both versions work in turns on this machine: see
`tests.tools.benchmarks.versions`. What seems slower is measured once more, by itself, and only what
is slower both times counts. That fails, and names the commits.
"""

from __future__ import annotations

import argparse
import io
import subprocess
import sys
import tarfile
from collections.abc import Awaitable, Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import NamedTuple, TypeAlias

import anyio

from tests.support.json_program import ROOT
from tests.tools.benchmarks import versions

MOST = 0.15
"""The part of its speed by which an order may be slower."""
AGE = "1 day ago"
ROUNDS, STARTS = 20, 3

Ratios: TypeAlias = Mapping[str, Sequence[float]]
"""For each order the ratios of this version's rate to the other's."""
Measure: TypeAlias = Callable[[Sequence[str]], Awaitable[Ratios]]


class Change(NamedTuple):
    """The commits from one that is not among them to this one."""

    base: str
    head: str
    subjects: list[str]
    """Each commit, with its subject; the newest first."""


def git(*arguments: str, root: Path = ROOT) -> str:
    """Return what a command of git prints."""
    command = ["git", "-C", str(root), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def change_since(base: str, root: Path = ROOT) -> Change | None:
    """Return the commits since a base; since a day ago if it is empty. None if there are none.

    Raises:
        ValueError: There is no commit so old.
    """
    if not base:
        base = git("rev-list", "-1", "--first-parent", f"--before={AGE}", "HEAD", root=root)
        if not base:
            raise ValueError("no commit is a day old: name one with --base")
    found = git("log", "--format=%h %s", f"{base}..HEAD", root=root)
    if not found:
        return None
    short, head = (git("rev-parse", "--short", one, root=root) for one in (base, "HEAD"))
    return Change(short, head, found.splitlines())


def slower(ratios: Ratios, most: float) -> dict[str, float]:
    """Return the orders whose median is slower by more than that part, with it."""
    medians = {order: median(found) for order, found in ratios.items()}
    return {order: one for order, one in medians.items() if one < 1 - most}


async def regressions(measure: Measure, orders: Sequence[str], most: float) -> dict[str, float]:
    """Measure, and return the orders that are slower twice, each with the better of its medians."""
    first = slower(await measure(orders), most)
    if not first:
        return {}
    second = slower(await measure(tuple(first)), most)
    return {order: max(first[order], second[order]) for order in second}


def text_of(found: Mapping[str, float], change: Change) -> str:
    """Return what is told of regressions."""
    lines = [f"{order}: {ratio:.2f} of the speed before" for order, ratio in found.items()]
    return "\n".join([*lines, f"between {change.base} and {change.head}:", *change.subjects])


@contextmanager
def checkout(commit: str) -> Generator[Path, None, None]:
    """Yield a folder with the files of another commit."""
    command = ["git", "-C", str(ROOT), "archive", commit, "fibaction", "transports"]
    files = subprocess.run(command, check=True, capture_output=True).stdout
    with TemporaryDirectory() as folder:
        with tarfile.open(fileobj=io.BytesIO(files)) as archive:
            archive.extractall(folder, filter="data")
        yield Path(folder).resolve()


async def compare(change: Change, most: float) -> dict[str, float]:
    """Return the regressions of a change."""
    with checkout(change.base) as folder:

        async def measure(orders: Sequence[str]) -> Ratios:
            found = await versions.beside(folder, ROUNDS, STARTS, orders)
            ratios = {order: [one for start in of for one in start] for order, of in found.items()}
            for order, all_of_it in ratios.items():
                print(f"{order:16} {median(all_of_it):.3f}", flush=True)
            return ratios

        return await regressions(measure, versions.ORDERS, most)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.benchmarks.regression")
    parser.add_argument("--base", default="", help="the commit to compare with")
    parser.add_argument("--most", type=float, default=MOST, help="(default: %(default)g)")
    arguments = parser.parse_args()
    try:
        change = change_since(arguments.base)
    except ValueError as exc:
        parser.error(str(exc))
    if change is None:
        print("nothing has landed since then")
        return
    print(f"rate of {change.head} to that of {change.base} (more than 1: faster)", flush=True)
    if found := anyio.run(compare, change, arguments.most):
        sys.exit(text_of(found, change))


if __name__ == "__main__":
    main()

"""The long trials of each night: their runs, and what their programs share.

    python -m tests.trials NAME...      # soak kills lossy fleet fuzz attack

Each run is a program with its own options, for example `python -m tests.kills --seconds 60`; all
runs of a trial are made, and it fails if one of them does. `make test` has a short form of each.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from time import monotonic

ROOT = Path(__file__).resolve().parents[1]

TRIALS = {
    "soak": ["tests.soak --keep", "tests.soak --load 4 --keep", "tests.soak.peers"],
    "kills": [
        "tests.kills --recovery abort",
        "tests.kills --recovery rerun",
        "pytest -q tests/stores/test_sqlite_store.py -k after_kills --timeout 600",
    ],
    "lossy": ["tests.lossy"],
    "fleet": ["tests.fleet all --times 10"],
    "fuzz": [
        f"tests.fuzz.{target} -max_total_time=30"
        for target in ("wire", "websocket", "web", "rosbridge", "rtps")
    ],
    "attack": ["tests.hostile"],
}
"""The runs of each trial: a module, and its arguments."""

LONGER = {"FIBACTION_KILLS": "100"}
"""The environment that makes trials of tests that are short elsewhere."""


def command_line(module: str, about: str | None) -> argparse.ArgumentParser:
    """Return the command line of a program of a trial, described by its docstring."""
    return argparse.ArgumentParser(
        prog=f"python -m {module}",
        description=about,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def seconds(text: str) -> float:
    """Return a time that is more than 0."""
    number = float(text)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not more than 0")
    return number


def count(text: str) -> int:
    """Return a number of 1 or more."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text} is not 1 or more")
    return number


def add_names(parser: argparse.ArgumentParser, what: str) -> None:
    """Let the user choose some of several by parts of their names."""
    parser.add_argument("names", nargs="*", help=f"parts of the names of {what}; all if not given")


def named(parser: argparse.ArgumentParser, parts: list[str], names: Iterable[str]) -> list[str]:
    """Return the names that the user has chosen; it is an error if there is none."""
    known = list(names)
    chosen = [name for name in known if any(part in name for part in parts or [""])]
    if not chosen:
        parser.error(f"nothing has such a name; there are {', '.join(known)}")
    return chosen


def main(*words: str) -> int:
    """Run trials, and return the exit status."""
    parser = command_line("tests.trials", __doc__)
    parser.add_argument("trials", nargs="+", choices=TRIALS, metavar="NAME")
    failed = []
    for run in [run for name in parser.parse_args(words or None).trials for run in TRIALS[name]]:
        begun = monotonic()
        print(f"---- python -m {run}", flush=True)
        command = [sys.executable, "-m", *run.split()]
        if subprocess.run(command, cwd=ROOT, env=os.environ | LONGER).returncode:
            failed.append(run)
        print(f"---- {monotonic() - begun:.0f} s", flush=True)
    for run in failed:
        print(f"failed: python -m {run}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())

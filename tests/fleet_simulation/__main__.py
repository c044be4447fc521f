"""Run seeds until the time is up, or one fails: see the package."""

from __future__ import annotations

import argparse
import secrets
import sys
import time
from collections import Counter

from tests.fleet_simulation.world import simulate

SEEDS = 2**32
"""The number of seeds that a fresh one is chosen from."""


def main(*words: str) -> int:
    """Run `python -m tests.fleet_simulation` with these arguments, and return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.fleet_simulation",
        description="Run fleets from a fresh seed on until the time is up, or one fails.",
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="by the real clock (60)")
    parser.add_argument("--seed", type=int, help="begin with this seed")
    parser.add_argument("--once", action="store_true", help="run one seed only")
    chosen = parser.parse_args(words or None)
    seed = secrets.randbelow(SEEDS) if chosen.seed is None else chosen.seed
    print(f"first seed: {seed}", flush=True)
    begun = time.perf_counter()
    counts: Counter[str] = Counter()
    while time.perf_counter() - begun < chosen.seconds:
        report = simulate(seed)
        counts.update(
            seeds=1,
            goals=report.goals,
            takeovers=report.takeovers,
            kills=report.kills,
            cuts=report.cuts,
        )
        if report.violations:
            print(f"seed {seed}:", *report.violations, sep="\n  ")
            return 1
        if chosen.once:
            break
        seed += 1
    print(dict(counts))
    return 0


if __name__ == "__main__":
    sys.exit(main())

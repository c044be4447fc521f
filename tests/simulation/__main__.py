"""Run scenarios until the time is up, or one fails: see the package."""

from __future__ import annotations

import argparse
import gc
import json
import secrets
import sys
import time
from collections import Counter

from tests.simulation.generator import scenario_of
from tests.simulation.world import Report, simulate

SEEDS = 2**32
"""The number of seeds that a fresh one is chosen from: short to type, and rarely the same twice."""

COLLECTED = 100
"""Scenarios after which their garbage is collected."""


def main(*words: str) -> int:
    """Run `python -m tests.simulation` with these arguments, and return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.simulation",
        description="Run scenarios from a fresh seed on until the time is up, or one fails.",
    )
    parser.add_argument(
        "--seconds", type=float, default=60.0, help="how long, by the real clock (default 60)"
    )
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--seed", type=int, help="run this scenario, and no other")
    which.add_argument("--from", type=int, dest="first", help="begin with this seed, and count on")
    parser.add_argument("--store", action="store_true", help="give all servers a store")
    parser.add_argument("--trace", action="store_true", help="with --seed: print all events")
    chosen = parser.parse_args(words or None)
    if chosen.trace and chosen.seed is None:
        parser.error("--trace needs --seed: it prints the events of one scenario")
    if chosen.seed is not None:
        return _replay(chosen.seed, trace=chosen.trace, store=chosen.store)
    first = secrets.randbelow(SEEDS) if chosen.first is None else chosen.first
    return _explore(first, chosen.seconds, store=chosen.store)


def _replay(seed: int, *, trace: bool, store: bool) -> int:
    report = simulate(scenario_of(seed, store=store))
    if trace or report.violations:
        print("\n".join(report.trace))
    for violation in report.violations:
        print(f"VIOLATED {violation}")
    print(f"seed {seed}: {report.digest}")
    return int(bool(report.violations))


def _explore(first: int, seconds: float, *, store: bool) -> int:
    print(f"first seed: {first}", flush=True)
    begun = time.perf_counter()
    counts: Counter[str] = Counter()
    seed = first
    while (elapsed := time.perf_counter() - begun) < seconds:
        report = simulate(scenario_of(seed, store=store))
        if report.violations:
            tell_failure(report)
            return 1
        _count(counts, report)
        seed += 1
        if counts["scenarios"] % COLLECTED == 0:
            # What a scenario leaves is old after it, so Python would hardly ever look at it, and
            # memory would grow by some 160 kB with each.
            gc.collect()
    counts["per_minute"] = round(60 * counts["scenarios"] / elapsed)
    print(json.dumps(counts))
    return 0


def _count(counts: Counter[str], report: Report) -> None:
    counts["scenarios"] += 1
    counts.update(report.crashes)
    counts.update(report.checks)
    counts["goals"] += report.goals
    counts["connections"] += report.connections
    counts["cuts"] += report.cuts
    counts["restarts"] += report.restarts
    counts["virtual_seconds"] += round(report.seconds)


def tell_failure(report: Report) -> None:
    """Print the trace, the violations, and the command that runs the scenario again."""
    print("\n".join(report.trace))
    print(f"\nseed {report.scenario.seed} fails:")
    for violation in report.violations:
        print(f"  {violation}")
    store = " --store" if report.scenario.server.store is not None else ""
    print(f"again: python -m tests.simulation --seed {report.scenario.seed}{store} --trace")


if __name__ == "__main__":
    sys.exit(main())

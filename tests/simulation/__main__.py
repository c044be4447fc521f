"""Run scenarios until the time is up, or one fails: see the package."""

from __future__ import annotations

import argparse
import json
import secrets
import sys
import time

from tests.simulation.generator import scenario_of
from tests.simulation.world import Report, simulate

SEEDS = 2**32
"""The number of seeds that a fresh one is chosen from: short to type, and rarely the same twice."""


def main() -> int:
    """Run the command `python -m tests.simulation`, and return the exit code."""
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
    parser.add_argument("--trace", action="store_true", help="with --seed: print all events")
    chosen = parser.parse_args()
    if chosen.trace and chosen.seed is None:
        parser.error("--trace needs --seed: it prints the events of one scenario")
    if chosen.seed is not None:
        return _replay(chosen.seed, trace=chosen.trace)
    first = secrets.randbelow(SEEDS) if chosen.first is None else chosen.first
    return _explore(first, chosen.seconds)


def _replay(seed: int, *, trace: bool) -> int:
    report = simulate(scenario_of(seed))
    if trace or report.violations:
        print("\n".join(report.trace))
    for violation in report.violations:
        print(f"VIOLATED {violation}")
    print(f"seed {seed}: {report.digest}")
    return int(bool(report.violations))


def _explore(first: int, seconds: float) -> int:
    print(f"first seed: {first}", flush=True)
    begun = time.perf_counter()
    counts = dict.fromkeys(
        ("scenarios", "goals", "connections", "cuts", "restarts", "virtual_seconds"), 0.0
    )
    seed = first
    while (elapsed := time.perf_counter() - begun) < seconds:
        report = simulate(scenario_of(seed))
        if report.violations:
            tell_failure(report)
            return 1
        _count(counts, report)
        seed += 1
    counts["per_minute"] = 60 * counts["scenarios"] / elapsed
    print(json.dumps({name: round(count) for name, count in counts.items()}))
    return 0


def _count(counts: dict[str, float], report: Report) -> None:
    counts["scenarios"] += 1
    counts["goals"] += report.goals
    counts["connections"] += report.connections
    counts["cuts"] += report.cuts
    counts["restarts"] += report.restarts
    counts["virtual_seconds"] += report.seconds


def tell_failure(report: Report) -> None:
    """Print the trace, the violations, and the command that runs the scenario again."""
    print("\n".join(report.trace))
    print(f"\nseed {report.scenario.seed} fails:")
    for violation in report.violations:
        print(f"  {violation}")
    print(f"again: python -m tests.simulation --seed {report.scenario.seed} --trace")


if __name__ == "__main__":
    sys.exit(main())

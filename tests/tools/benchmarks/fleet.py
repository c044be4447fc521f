"""A fleet beside bare NATS, beside `tcp://`, beside taskiq, and how it grows.

    python -m tests.tools.benchmarks.fleet [--rounds N] [PART ...]

The parts:

one, three   goals over `nats://` beside nats-py alone with the same operations of JetStream, at 1,
             100 and 500 at once, with one broker and with three
feedback     the feedback of one goal, beside `tcp://`
workers      goals that take a while, with 1, 2 and 4 workers that run few of them at once
active       the cost of one more goal, and the memory, beside 10, 1,000 and 10,000 active goals
taskiq       goals beside tasks of taskiq with Redis, if both can be had

Both sides of a ratio run in turns, so that other programs disturb both. `make bench` ends with it.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import AbstractAsyncContextManager, AsyncExitStack, contextmanager
from pathlib import Path
from statistics import median

import anyio

from tests.fleet.servers import servers
from tests.support.nats_server import PROGRAM
from tests.tools.benchmarks import over_taskiq
from tests.tools.benchmarks.over_fibaction import CONCURRENCY, FLEET, SECONDS
from tests.tools.benchmarks.program import Program, program
from tests.tools.benchmarks.rounds import calibrated
from tests.tools.benchmarks.ways import BETWEEN, WAYS, Pair, Way, started

ORDERS = {"goals": 1, "hundred": 100, "five_hundred": 500}
"""The number of goals at once of each order."""
TIME = 1.0
"""Seconds that each side works in a round."""
ACTIVE = (10, 1000, 10_000)


@contextmanager
def brokers(count: int) -> Iterator[Mapping[str, str]]:
    """Run brokers, and yield the environment of those that use them."""
    with servers(count) as running:
        yield {FLEET: f"nats://{running.hosts}/bench"}


def over(name: str, environment: Mapping[str, str]) -> AbstractAsyncContextManager[Pair]:
    """Run both ends of a contender."""
    return started(Way(name, BETWEEN, name), environment)


async def in_turns(sides: Mapping[str, Program], order: str, rounds: int) -> list[dict[str, float]]:
    """Return the rates of all sides in each round."""
    times = {key: (await calibrated(one, order, TIME))[0] for key, one in sides.items()}
    found: list[dict[str, float]] = []
    for _ in range(rounds):
        rates: dict[str, float] = {}
        for key, one in sides.items():
            done, seconds = await one.ask(order, times[key])
            rates[key] = done / seconds
        found.append(rates)
    return found


def tell(what: str, found: list[dict[str, float]], one: str, other: str) -> None:
    """Print the rates of two sides, and their ratio in each round."""
    ratios = sorted(rates[one] / rates[other] for rates in found)
    print(
        f"{what}: {median(rates[one] for rates in found):.0f}/s,"
        f" {median(ratios):.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f}) of {other} with"
        f" {median(rates[other] for rates in found):.0f}/s",
        flush=True,
    )


async def beside_bare_nats(count: int, rounds: int) -> None:
    what = "one broker" if count == 1 else f"{count} brokers"
    with brokers(count) as environment:
        async with AsyncExitStack() as stack:
            sides = {
                key: (await stack.enter_async_context(over(name, environment))).client
                for key, name in (("fleet", "fibaction.fleet"), ("nats_bare", "nats_bare"))
            }
            for order, at_once in ORDERS.items():
                found = await in_turns(sides, order, rounds)
                tell(f"{what}, {at_once:3} at once", found, "fleet", "nats_bare")
            await _latencies(what, sides, rounds)


async def _latencies(name: str, sides: Mapping[str, Program], rounds: int) -> None:
    medians = [
        {
            key: median(ended for _, ended in await one.ask("goal_times", 100))
            for key, one in sides.items()
        }
        for _ in range(rounds)
    ]
    ratios = sorted(one["fleet"] / one["nats_bare"] for one in medians)
    print(
        f"{name}, one at a time: {median(one['fleet'] for one in medians) * 1e3:.2f} ms,"
        f" {median(ratios):.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f}) times that of nats_bare"
    )


async def one(rounds: int) -> None:
    await beside_bare_nats(1, rounds)


async def three(rounds: int) -> None:
    await beside_bare_nats(3, rounds)


async def feedback(rounds: int) -> None:
    with brokers(1) as environment:
        async with (
            over("fibaction.fleet", environment) as over_nats,
            started(WAYS["tcp"]) as over_tcp,
        ):
            sides = {"nats://": over_nats.client, "tcp://": over_tcp.client}
            found = await in_turns(sides, "feedback", rounds)
            tell("feedback of one goal", found, "nats://", "tcp://")


async def workers(rounds: int) -> None:
    first = 0.0
    worker = ("-m", "tests.tools.benchmarks.child", "server", "fibaction.slow_fleet")
    for count in (1, 2, 4):
        with brokers(1) as environment:
            async with AsyncExitStack() as stack:
                for _ in range(count - 1):
                    running = program(sys.executable, *worker, environment=environment)
                    await (await stack.enter_async_context(running)).line()
                pair = await stack.enter_async_context(over("fibaction.slow_fleet", environment))
                found = await in_turns({"fleet": pair.client}, "hundred", rounds)
        rate = median(rates["fleet"] for rates in found)
        first = first or rate
        print(
            f"{count} workers: {rate:.0f} goals/s, {rate * SECONDS / CONCURRENCY / count:.2f} of"
            f" the most they can do, {rate / first:.2f} times as many as one",
            flush=True,
        )


async def active(rounds: int) -> None:
    with brokers(1) as environment:
        async with over("fibaction.fleet", environment) as (server, client):
            assert server is not None
            await client.ask("goals", 200)
            held, first = 0, 0.0
            for count in ACTIVE:
                await client.ask("hold", count - held)
                held = count
                found = await in_turns({"fleet": client}, "goals", rounds)
                rate = median(rates["fleet"] for rates in found)
                first = first or rate
                print(
                    f"{count:6,} active goals: {rate:.0f} goals/s one at a time, cost"
                    f" {first / rate:.2f}; worker {server.resident / 1e6:.0f} MB, client"
                    f" {client.resident / 1e6:.0f} MB",
                    flush=True,
                )


async def taskiq(rounds: int) -> None:
    if why := over_taskiq.missing_here():
        print(f"left out is taskiq: {why}")
        return
    with (
        brokers(1) as environment,
        tempfile.TemporaryDirectory() as folder,
        over_taskiq.redis(Path(folder)) as url,
    ):
        both = {**environment, over_taskiq.REDIS: url}
        async with over("fibaction.fleet", both) as ours, over("taskiq", both) as theirs:
            sides = {"fleet": ours.client, "taskiq": theirs.client}
            for order, at_once in ORDERS.items():
                found = await in_turns(sides, order, rounds)
                tell(f"{at_once:3} at once", found, "fleet", "taskiq")


PARTS: dict[str, Callable[[int], Awaitable[None]]] = {
    part.__name__: part for part in (one, three, feedback, workers, active, taskiq)
}


async def measure(parts: list[str], rounds: int) -> None:
    for part in parts:
        await PARTS[part](rounds)


def main(*words: str) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.tools.benchmarks.fleet",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args(words or None)
    for part in arguments.parts:
        if part not in PARTS:
            parser.error(f"unknown part {part!r}; the parts are {', '.join(PARTS)}")
    if PROGRAM is None:
        print("left out is the fleet: nats-server is not installed")
        return
    anyio.run(measure, arguments.parts or list(PARTS), arguments.rounds)


if __name__ == "__main__":
    main()

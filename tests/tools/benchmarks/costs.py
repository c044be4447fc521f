"""The cost of one message of a client, at a server with many active goals.

    python -m tests.tools.benchmarks.costs [--goals N] [--write]

A server is a process of its own. One connection has sent the goals, and another sends messages of
one kind, of about 100 bytes, and waits until all are answered. The processor's time of the server,
and the memory that it holds more than before, are divided by the number of messages. `--write`
puts the table into docs/comparisons.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import anyio

from fibaction.wire.messages import (
    AskPeers,
    AskPlaces,
    AwaitServer,
    CancelGoals,
    Close,
    Credit,
    Finished,
    Follow,
    GoalChanged,
    ListActions,
    Ping,
    Received,
    SendGoal,
    WatchStatus,
)
from tests.hostile.arena import Server, started
from tests.hostile.attack import MOST, goal_id, sending
from tests.hostile.goal_attacks import ONE, hold
from tests.hostile.meter import Reading
from tests.hostile.raw_client import Raw, Target
from tests.hostile.victim import Settings
from tests.support.fibonacci import FIBONACCI, Goal
from tests.support.page_parts import markdown_table
from tests.tools.benchmarks.pages import run

GOALS = 10_000
IDLE = 0.001
"""Seconds of the processor that an idle server uses in 50 ms, at most."""
CHANGED = 40  # the tag of GoalChanged
SAME = goal_id()
SHORT, LONG = FIBONACCI.goal.encode(Goal(1)), FIBONACCI.goal.encode(Goal(20))


class Kind(NamedTuple):
    """A kind of message, and what one may cost."""

    name: str
    make: Callable[[int], Any]
    most: float = 300
    """The most that one may cost, as a multiple of a `Ping` in the same run."""
    most_for_each: float = 0.0
    """Multiples more for each goal of the action."""
    times: int = 500
    makes_goals: bool = False
    """True if it is followed by `Received`, so that the connection follows no goal for ever."""


def sends(name: str, make: Callable[[int], Any], *, ends: bool = True) -> Kind:
    return Kind(f"`SendGoal`, {name}", make, 1000, makes_goals=ends)


def of_all(name: str, make: Callable[[int], Any], most_for_each: float) -> Kind:
    return Kind(name, make, most_for_each=most_for_each, times=10)


KINDS = [
    Kind("`Ping`", lambda id: Ping(), 30, times=2000),
    Kind(
        "`Credit`, `Close`, `Received` of no request", lambda id: Credit(id, MOST), 30, times=2000
    ),
    Kind("`ListActions`, of 12 actions", ListActions),
    Kind("`AskPeers`, with 3 connections", lambda id: AskPeers(id, "deaf")),
    Kind("`AwaitServer`", lambda id: AwaitServer(id, "deaf")),
    Kind("`AwaitServer` of an action that is not served", lambda id: AwaitServer(id, "x" * 60)),
    sends("which ends at once", lambda id: goal(id, SHORT)),
    sends("with 20 feedback messages", lambda id: goal(id, LONG)),
    sends("which does not end", lambda id: sending(id, "deaf", ONE), ends=False),
    sends("again the same", lambda id: goal(id, SHORT, SAME)),
    sends("rejected", lambda id: sending(id, "fibonacci", b"\x01"), ends=False),
    Kind(
        "`Follow` of a goal that does not exist",
        lambda id: Follow(id, "deaf", goal_id(), None, True, MOST),
    ),
    Kind("`CancelGoals` of one goal", lambda id: CancelGoals(id, "deaf", goal_id(), None)),
    of_all("`CancelGoals` of all goals", lambda id: CancelGoals(id, "deaf", None, None), 20),
    of_all("`WatchStatus`, and all goals read", lambda id: WatchStatus(id, "deaf", MOST), 60),
    of_all("`AskPlaces`, and no goal waits", lambda id: AskPlaces(id, "deaf", MOST), 20),
]
"""The kinds in the order of the table. The first `CancelGoals` of all changes each goal once."""


def goal(id: int, order: bytes, name: bytes | None = None) -> SendGoal:
    """Return a message that sends a goal of Fibonacci."""
    return sending(id, "fibonacci", order, MOST, name)


class Cost(NamedTuple):
    """The cost of one message, on the average."""

    microseconds: float
    held: float
    """Bytes that the server holds more than before, after the answer."""


async def cost_of(kind: Kind, server: Server, raw: Raw, goals: int) -> Cost:
    """Send messages of a kind, and return the cost of each."""
    # The first messages fill caches and free lists.
    await send(kind, raw, max(1, kind.times // 4), goals)
    await rest(server)
    before = await server.reset()
    await send(kind, raw, kind.times, goals)
    after = await rest(server)
    held = max(0, after.memory - before.memory)
    return Cost(after.cpu * 1e6 / kind.times, held / kind.times)


async def send(kind: Kind, raw: Raw, times: int, goals: int) -> None:
    """Send so many messages, and end their goals and statuses."""
    if kind.name.startswith("`WatchStatus`"):
        for id in [next(raw.ids) for _ in range(times)]:
            seen = raw.counts[CHANGED]
            await raw.say(kind.make(id))
            await raw.count(GoalChanged, seen + goals)
            await raw.say(Close(id))
            await raw.hear(Finished, id)
        return
    ids = [next(raw.ids) for _ in range(times)]
    for start in range(0, len(ids), 100):
        piece = ids[start : start + 100]
        await raw.say(*map(kind.make, piece))
        await raw.fence()
        if kind.makes_goals:
            await raw.say(*map(Received, piece))
    await raw.fence()


async def rest(server: Server) -> Reading:
    """Wait until the server has nothing more to do, and return what its meter says."""
    now = await server.read()
    while True:
        await anyio.sleep(0.05)
        before, now = now, await server.read()
        if now.cpu - before.cpu < IDLE:
            return now


def too_dear(found: Mapping[str, Cost], goals: int) -> list[str]:
    """Return the kinds that cost more than their bounds, with so many active goals."""
    ping = found[KINDS[0].name].microseconds
    times = {kind: found[kind.name].microseconds / ping for kind in KINDS}
    return [
        f"{kind.name}: {cost:.0f} times a ping"
        for kind, cost in times.items()
        if cost > kind.most + goals * kind.most_for_each
    ]


async def costs(goals: int) -> dict[str, Cost]:
    """Return the cost of each kind of message at a server with so many active goals."""
    found: dict[str, Cost] = {}
    with started(Settings()) as server:
        target = Target(server.url)
        async with target.dial() as sender, target.dial() as raw:
            await hold(sender, "deaf", goals)
            for kind in KINDS:
                found[kind.name] = await cost_of(kind, server, raw, goals)
    return found


async def measure(goals: int) -> str:
    """Return the table for the page."""
    head = [f"One message, with {goals:,} active goals", "Microseconds", "Bytes held"]
    rows = [
        [kind, f"{one.microseconds:,.0f}", f"{one.held:,.0f}"]
        for kind, one in (await costs(goals)).items()
    ]
    return markdown_table(head, rows)


def main() -> None:
    """Print the table, or write it."""
    run("costs", measure, goals=GOALS)


if __name__ == "__main__":
    main()

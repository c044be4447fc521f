"""The pairs of a client and a server between which goals are sent, and what is counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from itertools import pairwise
from time import perf_counter
from typing import TypeAlias

import msgspec

from fibaction import ActionServer, GoalHandle, serve
from fibaction.words.errors import ActionError
from tests.lossy.bad_network import Weather, bad_network
from tests.ros2.stock.process import Peer
from tests.support.fibonacci import Feedback, Goal, Result
from tests.transports.cyclone import dds_end
from tests.transports.cyclone.dds_end import NINE, FibonacciClient, cyclone_client, cyclone_server

ORDER = 9
TERMS = [NINE[: size + 2] for size in range(1, ORDER)]
SUCCEEDED = 4


class Findings(msgspec.Struct, kw_only=True):
    """What has become of the goals."""

    seconds: list[float] = []
    """The time of each goal that had its result."""
    lost: int = 0
    """Goals without the right result."""
    twice: int = 0
    """Goals that ran twice, or that were answered twice."""
    disordered: int = 0
    """Goals with feedback twice, or out of order."""
    errors: list[str] = []
    """The errors of the goals that were lost."""
    incomplete: int = 0
    """Goals without all of their feedback."""

    def at(self, share: float) -> float:
        """Return the time within which this share of the goals ended."""
        times = sorted(self.seconds)
        return times[min(len(times) - 1, int(share * len(times)))] if times else 0.0

    @property
    def is_right(self) -> bool:
        """True if nothing is lost, double or out of order."""
        return not (self.lost or self.twice or self.disordered)

    def note(self, feedback: list[list[int]]) -> None:
        """Note the feedback of a goal."""
        places = [TERMS.index(terms) for terms in feedback]
        self.disordered += any(one >= next_one for one, next_one in pairwise(places))
        self.incomplete += len(set(places)) < len(TERMS)


One: TypeAlias = Callable[[], Awaitable[tuple[object, list[list[int]]]]]
"""Runs one goal; gives its result, and its feedback."""


async def _run(one: One, count: int, findings: Findings) -> None:
    for _ in range(count):
        begun = perf_counter()
        try:
            result, feedback = await one()
        except ActionError as error:
            findings.lost += 1
            findings.errors.append(f"{type(error).__name__}: {error}")
            continue
        findings.seconds.append(perf_counter() - begun)
        findings.lost += result != NINE
        findings.note(feedback)


def _by_ours(client: FibonacciClient) -> One:
    async def one() -> tuple[object, list[list[int]]]:
        async with client.send_goal(Goal(ORDER)) as goal:
            feedback = [each.partial_sequence async for each in goal.feedback]
            return (await goal.result()).sequence, feedback

    return one


def _by_cyclone(client: Peer) -> One:
    async def one() -> tuple[object, list[list[int]]]:
        goal = (await client.ask("send", order=ORDER))["goal"]
        outcome = await client.ask("result", goal=goal)
        feedback = await client.ask("feedback", goal=goal, count=len(TERMS))
        return outcome["status"] == SUCCEEDED and outcome["sequence"], feedback

    return one


@asynccontextmanager
async def _our_server(name: str, runs: Counter[bytes]) -> AsyncGenerator[None, None]:
    async def execute(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        runs[bytes(goal.goal_id)] += 1
        async for each in dds_end.execute(goal):
            yield each

    async with serve(ActionServer(dds_end.action(name), execute), "dds://"):
        yield


def _repeated(runs: Counter[bytes]) -> int:
    return sum(number - 1 for number in runs.values())


async def ours_to_ours(count: int, findings: Findings) -> None:
    """Our client at our server, both in this process."""
    name, runs = dds_end.new_name(), Counter[bytes]()
    async with _our_server(name, runs), dds_end.client(name) as client:
        await _run(_by_ours(client), count, findings)
    findings.twice += _repeated(runs)


async def ours_to_cyclone(count: int, findings: Findings) -> None:
    """Our client at a server on Cyclone DDS."""
    name = dds_end.new_name()
    # It may be offered a goal again if its answer was lost, and runs each ID once.
    async with cyclone_server(name), dds_end.client(name) as client:
        await _run(_by_ours(client), count, findings)


async def cyclone_to_ours(count: int, findings: Findings) -> None:
    """A client on Cyclone DDS at our server."""
    name, runs = dds_end.new_name(), Counter[bytes]()
    async with _our_server(name, runs), cyclone_client(name) as client:
        await _run(_by_cyclone(client), count, findings)
        findings.twice += _repeated(runs) + await client.ask("repeated")


PAIRS = {
    "ours to ours": (ours_to_ours, False),
    "ours to cyclone": (ours_to_cyclone, True),
    "cyclone to ours": (cyclone_to_ours, True),
}
"""Each with whether one of the two is in another process."""
MOST_INCOMPLETE = {"ours to cyclone": 1}
"""Other servers do not tell how many messages there were, and are asked for them only so often as
long as nothing is lost: if the first loss is the last feedback of a goal, it is not noticed."""


async def try_pair(pair: str, weather: Weather, count: int, seed: int) -> Findings:
    """Send goals one after the other, and return what has become of them."""
    run, is_apart = PAIRS[pair]
    findings = Findings()
    with bad_network(weather, seed, inwards=is_apart):
        await run(count, findings)
    return findings

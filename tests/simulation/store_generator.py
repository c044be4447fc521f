"""The generator of stores, which are added to the scenario of a seed.

Its randomness is its own, so that a scenario without a store is the same as before there were any.
"""

from __future__ import annotations

import random
from typing import Literal

from msgspec.structs import replace

from tests.simulation.scenario import ClientPlan, Deed, Fault, Scenario, StoreFault, StorePlan, Work
from tests.support.memory_store import Fate

PART = 0.3
"""The part of the scenarios that have a store."""
WRITES = ("", "accept", "accept", "begin", "cancel", "checkpoint", "end", "end", "release")
FATES = (Fate.LOST, Fate.LOST, Fate.UNANSWERED, Fate.UNANSWERED, Fate.FAILED, Fate.DOUBTFUL)


def with_store(scenario: Scenario, span: float, *, always: bool = False) -> Scenario:
    """Return the scenario with a store and its faults, or, for some seeds, without."""
    chance = random.Random(f"store {scenario.seed}")
    if chance.random() >= PART and not always:
        return scenario
    server = replace(scenario.server, store=_plan(chance))
    clients = tuple(_keeping(chance, plan) for plan in scenario.clients)
    faults = [*scenario.faults, *_faults(chance, span)]
    return replace(
        scenario,
        climate="rough",
        server=server,
        clients=clients,
        faults=tuple(sorted(faults, key=lambda fault: fault.at)),
    )


def _plan(chance: random.Random) -> StorePlan:
    late = chance.choice([0.0, 0.0, 0.001, 0.02, 0.2])
    recoveries: list[Literal["abort", "rerun", "sync", "async"]]
    recoveries = ["abort", "rerun", "rerun", "sync", "async"]
    return StorePlan(
        recovery=chance.choice(recoveries),
        max_attempts=chance.choice([1, 2, 3, 3]),
        at_stop=chance.choice(["abort", "keep"]),
        delays=tuple(chance.choice([0.0, late]) for _ in range(7)),
        faults=tuple(
            StoreFault(
                what=chance.choice(WRITES),
                number=chance.choice([1, 1, 2, 3, 5, 8]),
                fate=chance.choice(FATES),
            )
            for _ in range(chance.choice([0, 1, 2, 3, 5, 8]))
        ),
        survivors=chance.choice([0, 0, 1, 2, 100]),
        away=chance.choice([0.0, 0.0, 0.01, 0.5, 3.0]),
    )


def _faults(chance: random.Random, span: float) -> list[Fault]:
    """Return restarts and crashes at any time, beside those at writes."""
    kinds: list[Literal["restart", "crash"]] = ["restart", "crash", "crash"]
    return [
        Fault(
            at=chance.uniform(0, span),
            kind=chance.choice(kinds),
            manner=chance.choice(["reset", "end", "silence"]),
            seconds=chance.choice([0.0, 0.01, 0.5, 3.0]),
        )
        for _ in range(chance.choice([0, 0, 1, 2, 4]))
    ]


def _keeping(chance: random.Random, plan: ClientPlan) -> ClientPlan:
    """Let some goals keep checkpoints."""

    def keeping(deed: Deed) -> Deed:
        work: Work = replace(deed.work, keeps=chance.choice([0, 1, 1, 3]))
        return replace(deed, work=work)

    return replace(plan, deeds=tuple(keeping(deed) for deed in plan.deeds))

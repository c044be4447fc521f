"""The generator of schedules, which are added to the scenario of a seed.

Its randomness is its own, so that a scenario without a schedule is the same as before there were
any.
"""

from __future__ import annotations

import itertools
import math
import random
from typing import Literal, TypeAlias

from msgspec.structs import replace

from tests.simulation.scenario import (
    KINDS,
    SUCCEEDING,
    ClientPlan,
    Deed,
    Scenario,
    SchedulePlan,
    Work,
)

WhenFull: TypeAlias = Literal["reject", "preempt", "replace"]

PART = 0.5
"""The part of the scenarios that have a schedule."""


def with_schedule(scenario: Scenario, span: float) -> Scenario:
    """Return the scenario with a schedule and goals that need it, or, for some seeds, without."""
    chance = random.Random(f"schedule {scenario.seed}")
    if chance.random() >= PART:
        return scenario
    server = replace(scenario.server, schedule=_plan(chance))
    clients = tuple(
        _busier(chance, plan, number, span) for number, plan in enumerate(scenario.clients)
    )
    return replace(scenario, server=server, clients=clients)


def _plan(chance: random.Random) -> SchedulePlan:
    by_key = chance.random() < 0.3
    concurrency = chance.choice([None, 1, 2]) if by_key else chance.choice([1, 1, 2])
    total = chance.choice([1, 2, 3]) if concurrency is None or chance.random() < 0.3 else None
    policies: list[WhenFull] = ["reject", "preempt", "preempt", "replace"]
    when_full = chance.choice(policies)
    queues: dict[WhenFull, list[int]] = {
        "reject": [0, 1, 3, 20],
        "preempt": [0, 0, 1, 3],
        "replace": [1, 2, 5],
    }
    plan = SchedulePlan(
        concurrency=concurrency,
        total=total,
        queue=chance.choice(queues[when_full]),
        when_full=when_full,
        keys=chance.choice([2, 3]) if by_key else 0,
        urgencies=chance.choice([0, 0, 3]),
        queue_timeout=chance.choice([math.inf, math.inf, 0.5, 3.0]),
        run_timeout=chance.choice([math.inf, math.inf, 0.2, 1.0]),
        handover=chance.choice([0.0, 0.3, 0.3, math.inf]) if when_full == "preempt" else 0.0,
        fails=chance.random() < 0.1,
    )
    if when_full == "reject" and not plan.queue:  # no goal ever waits
        return replace(plan, queue_timeout=math.inf)
    return plan


def _busier(chance: random.Random, plan: ClientPlan, number: int, span: float) -> ClientPlan:
    """Let some goals take longer, and add some, so that they wait for each other."""
    keys = itertools.count(20_000 + 1000 * number)

    def longer(work: Work) -> Work:
        if chance.random() < 0.5:
            return work
        kind = chance.choice([work.kind, "tidy", *SUCCEEDING])
        return replace(work, kind=kind, pause=chance.choice([work.pause, 0.03, 0.2]))

    def added() -> Deed:
        work = Work(
            next(keys),
            kind=chance.choice([*KINDS, *SUCCEEDING, *SUCCEEDING, "tidy"]),
            steps=chance.choice([1, 5, 12]),
            pause=chance.choice([0.01, 0.05, 0.2]),
            cleanup=chance.choice([0.0, 0.01, 0.5]),
        )
        kind = chance.choice(["send", "call quietly", "cancel", "cancel by id", "goals"])
        return Deed(
            at=chance.uniform(0, min(span, 1.0)),
            kind="cancel" if work.kind == "grasps" else kind,
            work=work,
            delay=chance.choice([0.0, 0.01, 0.1]),
            count=chance.choice([0, 0, 1]),
            target=chance.randrange(10),
        )

    deeds = [replace(deed, work=longer(deed.work)) for deed in plan.deeds]
    deeds += [added() for _ in range(chance.choice([0, 3, 6]))]
    return replace(plan, deeds=tuple(sorted(deeds, key=lambda deed: deed.at)))

"""The generator of hostile clients, which are added to the scenario of a seed.

Its randomness is its own, so that the honest part of a scenario is the same with them and without.
"""

from __future__ import annotations

import math
import random

from msgspec.structs import replace

from fibaction.wire.auth import Permission
from fibaction.wire.frames import LEAST_FRAME, MAX_FRAME
from tests.simulation.scenario import ATTACKS, KINDS, Attack, HostilePlan, Scenario, Work
from tests.simulation.streams import Weather

PART = 0.5
"""The part of the scenarios that have hostile clients."""
LONGEST_SILENCE = 10.0
"""Seconds for which a silent attack lasts at most: longer than a handshake may take."""


class _Generator:
    """The generator of the hostile clients of one scenario."""

    def __init__(self, seed: int, span: float) -> None:
        self.chance = random.Random(f"hostile {seed}")
        self.span = span
        self.keys = 10_000

    def plan(self, number: int) -> HostilePlan:
        chance = self.chance
        count = chance.choice([1, 2, 3, 5, 8])
        attacks = sorted((self._attack() for _ in range(count)), key=lambda attack: attack.at)
        return HostilePlan(
            name=f"hostile-{number}",
            weather=Weather(
                latency=chance.choice([0.0, 0.001]),
                pieces=chance.choice([1, 1, 3]),
                buffer=chance.choice([700, 2**16]),
            ),
            attacks=tuple(attacks),
            starts_at=chance.uniform(0, self.span / 2) if chance.random() < 0.3 else 0.0,
            reads=chance.choice(["all", "all", "slowly", "never"]),
            may=frozenset(one for one in Permission if chance.random() < 0.6),
            has_token=chance.random() < 0.8,
            has_session=chance.random() < 0.7,
            heartbeat=chance.choice([1.0, 1.0, 5.0, 3600.0]),
            max_frame=chance.choice([LEAST_FRAME, MAX_FRAME, MAX_FRAME]),
            leaves=chance.choice(["goodbye", "close", "silence"]),
        )

    def _attack(self) -> Attack:
        chance = self.chance
        kinds, weights = zip(*ATTACKS, strict=True)
        return Attack(
            at=chance.uniform(0, self.span * 1.1),
            kind=chance.choices(kinds, weights)[0],
            work=self._work(),
            count=chance.choice([1, 2, 5, 20, 40]),
            target=chance.randrange(10),
            credit=chance.choice([0, 0, 1, 1000, None]),
            pause=chance.choice([0.0, 0.1, LONGEST_SILENCE]),
        )

    def _work(self) -> Work:
        chance = self.chance
        self.keys += 1
        return Work(
            key=self.keys,
            kind=chance.choice(KINDS),
            steps=chance.choice([0, 1, 5, 40]),
            pause=chance.choice([0.0, 0.01, self.span / 20]),
            size=chance.choice([0, 10, 500]),
            decide=chance.choice([0.0, 0.001, 0.1]),
            rejects=chance.choices(["", "goal", "cancel"], [8, 1, 1])[0],
        )


def with_hostile_clients(scenario: Scenario, span: float) -> Scenario:
    """Return the scenario with hostile clients, or, for some seeds, without."""
    generator = _Generator(scenario.seed, span)
    chance = generator.chance
    if chance.random() >= PART:
        return scenario
    server = replace(
        scenario.server,
        # Low enough to be reached, and more than the honest clients of a scenario need.
        follows=chance.choice([10, 20]),
        requests=30,
        goals=40 if chance.random() < 0.2 else scenario.server.goals,
        # Those that say nothing may be as many, and keep no client out.
        connections=chance.choice([25, 1000]),
        asks_for_tokens=chance.random() < 0.5,
    )
    plans = tuple(generator.plan(number) for number in range(chance.choice([1, 1, 2])))
    if server.authorize == "open":
        plans = tuple(replace(plan, may=frozenset(Permission)) for plan in plans)
    return replace(scenario, server=server, hostile=plans)


def last_attack_of(plan: HostilePlan) -> float:
    """Return the time of a client's last attack; 0 if it has none."""
    return plan.starts_at + max((one.at for one in plan.attacks), default=-math.inf)

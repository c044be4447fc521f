"""The generator of scenarios: the same seed gives the same scenario."""

from __future__ import annotations

import math
import random
from typing import Literal

from tests.simulation.hostile_generator import with_hostile_clients
from tests.simulation.network import Direction
from tests.simulation.scenario import (
    DEEDS,
    KINDS,
    STARTS,
    ClientPlan,
    Climate,
    Deed,
    Fault,
    Scenario,
    ServerPlan,
    Work,
)
from tests.simulation.schedule_generator import with_schedule
from tests.simulation.store_generator import with_store
from tests.simulation.streams import Manner, Weather


class _Generator:
    """The generator of one scenario, whose methods are called once each, in a fixed order."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.chance = random.Random(f"scenario {seed}")
        climates: list[Climate] = ["calm", "gentle", "rough"]
        self.climate: Climate = self.chance.choices(climates, [3, 4, 4])[0]
        self.span = self.chance.choice([0.3, 1.0, 3.0, 8.0])
        self.keys = 0

    def scenario(self) -> Scenario:
        server = self._server()
        clients = tuple(self._client(number) for number in range(self.chance.choice([1, 1, 2, 3])))
        late = self._rough() and self.chance.random() < 0.1
        return Scenario(
            self.seed,
            self.climate,
            server,
            clients,
            self._faults(clients),
            server_at=self.chance.uniform(0, self.span) if late else 0.0,
            calls_back=self.chance.random() < 0.5,
        )

    def _rough(self) -> bool:
        return self.climate == "rough"

    def _one_of(self, *values: float) -> float:
        return self.chance.choice(values)

    def _server(self) -> ServerPlan:
        chance = self.chance
        rough = self._rough()
        results = chance.choice([0.0, 0.0, 0.05, 1.0, 60.0])
        return ServerPlan(
            feedback="latest" if chance.random() < 0.2 else "every",
            feedback_window=chance.choice([1, 2, 8, 64, 64]),
            stall_timeout=self._one_of(0, 0.05, 1, 10) if rough else 60.0,
            result_timeout=results,
            max_results=chance.choice([1, 2, 5, 1000]) if rough else 1000,
            shutdown_timeout=self._one_of(0, 0.1, 5),
            on_goal=chance.choice(["none", "none", "sync", "async"]),
            on_cancel=chance.choice(["none", "none", "sync", "async"]),
            interrupt_on_cancel=chance.random() < 0.85,
            heartbeat=self._one_of(0.2, 1, 1, 5) if rough else 1.0,
            orphans="cancel" if chance.random() < 0.3 else "keep",
            grace=self._one_of(0, 0.1, 2, 10) if rough else 60.0,
            authorize=chance.choice(["open", "open", "sync", "async"]),
            queue=chance.choice([500, 2**20, 2**20]),
            goals=2 if rough and chance.random() < 0.05 else 10_000,
        )

    def _weather(self) -> Weather:
        chance = self.chance
        return Weather(
            latency=self._one_of(0.0, 0.001, 0.02),
            jitter=self._one_of(0.0, 0.0, 0.005),
            pieces=chance.choice([1, 1, 3, 8]),
            buffer=chance.choice([700, 2**13, 2**16, 2**16]),
            dial=self._one_of(0.0, 0.002, 0.05),
        )

    def _client(self, number: int) -> ClientPlan:
        chance = self.chance
        rough, mild = self._rough(), self.climate != "calm"
        deeds = sorted(
            (self._deed(first=not index) for index in range(chance.choice([1, 2, 3, 5, 8]))),
            key=lambda deed: deed.at,
        )
        leaves = dies = math.inf
        if mild and chance.random() < 0.15:
            leaves = chance.uniform(0, self.span)
        elif rough and chance.random() < 0.1:
            dies = chance.uniform(0, self.span)
        return ClientPlan(
            name=f"client-{number}",
            weather=self._weather(),
            starts_at=chance.uniform(0, self.span / 2) if chance.random() < 0.3 else 0.0,
            heartbeat=self._one_of(0.2, 1, 1, 5) if rough else 1.0,
            reconnect=not rough or chance.random() < 0.9,
            reconnect_timeout=self._one_of(0, 0.5, 5, 60, 60) if rough else 60.0,
            window=chance.choice([1, 2, 3, 10, 256]),
            deeds=tuple(deeds),
            leaves_at=leaves,
            dies_at=dies,
        )

    def _deed(self, *, first: bool) -> Deed:
        chance = self.chance
        kinds, weights = zip(*DEEDS, strict=True)
        kind = chance.choice(STARTS) if first else chance.choices(kinds, weights)[0]
        impatient = chance.random() < 0.15
        return Deed(
            at=0.0 if first and chance.random() < 0.7 else chance.uniform(0, self.span),
            kind=kind,
            work=self._work(),
            patience=chance.uniform(0, self.span) if impatient else math.inf,
            delay=chance.choice([0.0, 0.001, 0.01, 0.1, self.span / 4]),
            count=chance.choice([0, 1, 2, 5]),
            target=chance.randrange(10),
        )

    def _work(self) -> Work:
        chance = self.chance
        self.keys += 1
        size = chance.choice([0, 0, 0, 10, 500])
        if chance.random() < 0.02:
            size = 100_000
        steps = chance.choice([0, 1, 2, 5, 12, 40])
        return Work(
            key=self.keys,
            kind=chance.choice(KINDS),
            steps=min(steps, 5) if size > 500 else steps,
            pause=chance.choice([0.0, 0.001, 0.01, 0.1, self.span / 20]),
            size=size,
            cleanup=chance.choice([0.0, 0.01, 0.5]),
            decide=chance.choice([0.0, 0.001, 0.1]),
            rejects=chance.choices(["", "goal", "goal by failing", "cancel"], [16, 1, 1, 2])[0],
        )

    def _faults(self, clients: tuple[ClientPlan, ...]) -> tuple[Fault, ...]:
        if self.climate == "calm":
            return ()
        number = self.chance.choice([1, 1, 2, 3])
        made = [self._fault(clients) for _ in range(number)]
        return tuple(sorted(made, key=lambda fault: fault.at))

    def _fault(self, clients: tuple[ClientPlan, ...]) -> Fault:
        client = self.chance.randrange(len(clients))
        at = self.chance.uniform(0, self.span * 1.2)
        if self.chance.random() < 0.6:
            # During a deed, since a random time would rarely hit one.
            deed = self.chance.choice(clients[client].deeds)
            lasts = min(deed.work.steps * deed.work.pause, self.span) + 0.05
            at = clients[client].starts_at + deed.at + self.chance.uniform(0, lasts)
        chance, rough = self.chance, self._rough()
        kinds: list[Literal["cut", "half-close", "freeze", "stale", "reject", "die at once"]]
        kinds = ["cut", "cut", "cut", "half-close", "freeze", "freeze", "stale", "reject"]
        kinds.append("die at once")
        manners: list[Manner] = ["reset", "reset", "end", "silence"]
        directions: list[tuple[Direction, ...]] = [("up",), ("down",), ("up", "down")]
        seconds = self._one_of(0.005, 0.1, 1, 5, 8)
        if rough and chance.random() < 0.3:
            seconds = self._one_of(20, 70, 200)
        fault = Fault(
            at=at,
            kind=chance.choice(kinds),
            client=client,
            manner=chance.choice(manners),
            directions=chance.choice(directions),
            seconds=seconds,
        )
        if rough and chance.random() < 0.25:
            away = self._one_of(0, 0.01, 0.5, 3)
            kind: Literal["restart", "crash"] = chance.choice(["restart", "crash"])
            fault = Fault(fault.at, kind, manner=fault.manner, seconds=away)
        return fault


def scenario_of(seed: int, *, store: bool = False) -> Scenario:
    """Return the scenario of a seed; with `store`, its variant that has a store in any case."""
    generator = _Generator(seed)
    scenario = with_hostile_clients(generator.scenario(), generator.span)
    scenario = with_schedule(scenario, generator.span)
    return with_store(scenario, generator.span, always=store)

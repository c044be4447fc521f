"""What is to happen in one run, as plain data, made from an integer.

A scenario says all that is decided beforehand: how the server and each client are set up, what the
clients do and when, and what goes wrong. The same seed gives the same scenario, and a scenario can
be made smaller by leaving parts out. Nothing here runs anything.
"""

from __future__ import annotations

import math
import random
from typing import Literal, TypeAlias

import msgspec

from fibaction import Action
from tests.simulation.network import Direction
from tests.simulation.streams import Manner, Weather

Climate: TypeAlias = Literal["calm", "gentle", "rough"]
"""How much goes wrong. In `calm` nothing does; in `gentle` lines fail, but never for longer than
everybody is prepared for; in `rough` anything may fail, for any time, and servers die."""


class Work(msgspec.Struct, frozen=True):
    """A goal: it says how its executor is to behave."""

    key: int
    """Different for each goal."""
    kind: str = "steady"
    steps: int = 3
    """How many feedback messages it yields, if it is let."""
    pause: float = 0.0
    """Seconds between two of them."""
    size: int = 0
    """Bytes of each of them, and of the result."""
    cleanup: float = 0.0
    """Seconds that it needs after it was interrupted."""
    decide: float = 0.0
    """Seconds that an async `on_goal` takes."""
    refuse: str = ""
    """What a callback is to do instead of agreeing: `reject`, `fail`; or `cancel`: refuse that."""


class Step(msgspec.Struct, frozen=True):
    """Feedback: the executor's own count, to be compared with the number that it arrives with."""

    count: int
    pad: bytes = b""


class Done(msgspec.Struct, frozen=True):
    """The result, whole or in part."""

    key: int
    count: int
    pad: bytes = b""


SIMULATED = Action("simulated", goal=Work, feedback=Step, result=Done)

KINDS = (
    "steady",  # awaits between its yields
    "busy",  # never awaits
    "bursts",  # awaits after several yields
    "instant",  # has nothing to say but its result
    "tidy",  # cleans up when it is interrupted, awaiting, and hands over what it has
    "polite",  # looks at cancel_requested
    "stubborn",  # takes no notice of being interrupted
    "raises",  # fails half-way
    "aborts",  # gives up half-way, with what it has
    "endless",  # goes on until it is interrupted
)


class ServerPlan(msgspec.Struct, frozen=True):
    """How each server of the run is set up."""

    feedback: Literal["every", "latest"] = "every"
    feedback_window: int = 64
    stall_timeout: float = 60.0
    result_timeout: float = 60.0
    max_results: int = 1000
    shutdown_timeout: float = 5.0
    on_goal: Literal["none", "sync", "async"] = "none"
    on_cancel: Literal["none", "sync", "async"] = "none"
    interrupt_on_cancel: bool = True
    heartbeat: float = 1.0
    orphans: Literal["keep", "cancel"] = "keep"
    grace: float = 60.0
    authorize: Literal["open", "sync", "async"] = "open"
    queue: int = 2**20
    goals: int = 10_000
    """How many goals one connection may follow."""


class Deed(msgspec.Struct, frozen=True):
    """One thing that a client does."""

    at: float
    """Seconds after the client's start."""
    kind: str
    work: Work
    """The goal that it sends, if it sends one."""
    patience: float = math.inf
    """After so many seconds whoever does it is canceled."""
    delay: float = 0.0
    """Seconds that it waits somewhere on the way, for instance between two reads."""
    count: int = 0
    """How much of something: of feedback to be read, for instance."""
    target: int = 0
    """Which of the goals that were sent before is meant."""


DEEDS = (
    ("send", 5),  # send, read everything, wait for the outcome
    ("call", 4),  # call with on_feedback
    ("call quietly", 2),  # call without
    ("leave", 3),  # leave the block of `async with` early
    ("cancel", 4),  # cancel it after a while, and wait for the outcome
    ("slow", 2),  # read slowly
    ("unread", 2),  # never read, and wait for the outcome
    ("beside", 2),  # wait for the outcome in one task, read in another
    ("twice", 2),  # send the same goal twice
    ("clash", 1),  # send another goal under an ID that is in use
    ("attach", 3),
    ("observe", 2),  # follow by the endpoint's stream, statuses included
    ("get result", 2),
    ("cancel by id", 2),
    ("cancel by stamp", 1),
    ("cancel by both", 1),
    ("cancel all", 1),
    ("goals", 1),
    ("events", 2),
    ("statuses", 2),
    ("wait for server", 1),
    ("ask", 1),  # actions() and peers()
)
STARTS = ("send", "call", "call quietly", "leave", "cancel", "slow", "unread", "beside", "twice")
"""Those that send a goal of their own."""


class ClientPlan(msgspec.Struct, frozen=True):
    """One client: how it is set up, and what it does."""

    name: str
    weather: Weather
    starts_at: float = 0.0
    heartbeat: float = 1.0
    reconnect: bool = True
    reconnect_timeout: float = 60.0
    window: int = 256
    deeds: tuple[Deed, ...] = ()
    leaves_at: float = math.inf
    """When it leaves its block, whatever is still under way, in seconds after its start."""
    dies_at: float = math.inf
    """When its process ends, without a word."""


class Fault(msgspec.Struct, frozen=True):
    """Something that goes wrong."""

    at: float
    kind: Literal[
        "cut", "half-close", "freeze", "stale", "refuse", "die at once", "restart", "crash"
    ]
    client: int = 0
    manner: Manner = "reset"
    directions: tuple[Direction, ...] = ("up", "down")
    seconds: float = 0.0


class Scenario(msgspec.Struct, frozen=True):
    """One run."""

    seed: int
    climate: Climate
    server: ServerPlan
    clients: tuple[ClientPlan, ...]
    faults: tuple[Fault, ...] = ()
    server_at: float = 0.0
    """When the first server starts."""
    calls_back: bool = False
    """Whether connections are those of asyncio's transports, or streams that tasks wait for."""

    @property
    def has_restarts(self) -> bool:
        """Whether there is more than one server, one after the other."""
        return any(fault.kind in ("restart", "crash") for fault in self.faults)


class _Maker:
    """Makes one scenario; each method is asked once, in a fixed order."""

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
            self.chance.uniform(0, self.span) if late else 0.0,
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
            refuse=chance.choices(["", "reject", "fail", "cancel"], [16, 1, 1, 2])[0],
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
            # While something is under way: chance alone would hit little.
            deed = self.chance.choice(clients[client].deeds)
            lasts = min(deed.work.steps * deed.work.pause, self.span) + 0.05
            at = clients[client].starts_at + deed.at + self.chance.uniform(0, lasts)
        chance, rough = self.chance, self._rough()
        kinds: list[Literal["cut", "half-close", "freeze", "stale", "refuse", "die at once"]]
        kinds = ["cut", "cut", "cut", "half-close", "freeze", "freeze", "stale", "refuse"]
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


def scenario_of(seed: int) -> Scenario:
    """The scenario of a seed."""
    return _Maker(seed).scenario()

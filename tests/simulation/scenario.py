"""What is to happen in one run, as plain data.

A scenario says all that is decided beforehand: how the server and each client are set up, what the
clients do and when, and what goes wrong. It can be made smaller by leaving parts out. Nothing here
runs anything.
"""

from __future__ import annotations

import math
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

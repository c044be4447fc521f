"""The plan of one run, as plain data.

A scenario has all that is decided before the run: the settings of the server and of each client,
the deeds of the clients with their times, and the faults. It can be made smaller by leaving parts
out.
"""

from __future__ import annotations

import math
from typing import Literal, TypeAlias

import msgspec

from fibaction import Action
from tests.simulation.network import Direction
from tests.simulation.streams import Manner, Weather

Climate: TypeAlias = Literal["calm", "gentle", "rough"]
"""The amount of faults: none in `calm`; in `gentle`, lines fail for less time than the timeouts of
clients and server; in `rough`, any part may fail for any time, and servers die."""


class Work(msgspec.Struct, frozen=True):
    """A goal, which controls how its executor behaves."""

    key: int
    """Different for each goal."""
    kind: str = "steady"
    steps: int = 3
    """The number of feedback messages that it yields unless it is interrupted."""
    pause: float = 0.0
    """Seconds between two feedback messages."""
    size: int = 0
    """Bytes of each feedback message, and of the result."""
    cleanup: float = 0.0
    """Seconds that the clean-up takes after an interruption."""
    decide: float = 0.0
    """Seconds that an async `on_goal` takes."""
    rejects: str = ""
    """The rejection by a callback: `goal`, `goal by failing`, or `cancel`; empty for none."""


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
    "instant",  # yields only its result
    "tidy",  # awaits in its clean-up after an interruption, and returns a partial result
    "polite",  # checks cancel_requested
    "stubborn",  # ignores interruptions
    "raises",  # fails half-way
    "aborts",  # gives up half-way, with what it has
    "endless",  # goes on until it is interrupted
)


class ServerPlan(msgspec.Struct, frozen=True):
    """The settings of each server of the run."""

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
    """The number of goals that one connection may follow."""


class Deed(msgspec.Struct, frozen=True):
    """One thing that a client does."""

    at: float
    """Seconds after the client's start."""
    kind: str
    work: Work
    """The goal of a deed that sends one."""
    patience: float = math.inf
    """Seconds after which the deed is canceled."""
    delay: float = 0.0
    """Seconds of a wait within the deed, for example between two reads."""
    count: int = 0
    """An amount, for example of feedback to be read."""
    target: int = 0
    """The index of the goal that is meant, among those that were sent before."""


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
    ("follow", 2),  # follow by the endpoint's stream, statuses included
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
"""The deeds that send a goal of their own."""


class ClientPlan(msgspec.Struct, frozen=True):
    """The settings and the deeds of one client."""

    name: str
    weather: Weather
    starts_at: float = 0.0
    heartbeat: float = 1.0
    reconnect: bool = True
    reconnect_timeout: float = 60.0
    window: int = 256
    deeds: tuple[Deed, ...] = ()
    leaves_at: float = math.inf
    """Seconds from its start until it leaves its block, even with deeds under way."""
    dies_at: float = math.inf
    """Seconds from its start until its process ends without closing its connection."""


class Fault(msgspec.Struct, frozen=True):
    """A fault of the network, or of the server's process."""

    at: float
    kind: Literal[
        "cut", "half-close", "freeze", "stale", "reject", "die at once", "restart", "crash"
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
    """Seconds until the first server starts."""
    calls_back: bool = False
    """True if connections are asyncio transports, false if they are streams that tasks await."""

    @property
    def has_restarts(self) -> bool:
        """True if the run has several servers, one after the other."""
        return any(fault.kind in ("restart", "crash") for fault in self.faults)

"""The plan of one run, as plain data.

A scenario has all that is decided before the run: the settings of the server and of each client,
the deeds of the clients with their times, the attacks of hostile clients, and the faults. It can be
made smaller by leaving parts out.
"""

from __future__ import annotations

import math
from typing import Literal, TypeAlias

import msgspec

from fibaction import Action, Schedule
from fibaction.wire.auth import Permission
from fibaction.wire.frames import MAX_FRAME
from tests.simulation.network import Direction
from tests.simulation.streams import Manner, Weather
from tests.support.memory_store import Fate

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
    keeps: int = 0
    """The number of feedback messages between two checkpoints; 0 for no checkpoints."""


class Step(msgspec.Struct, frozen=True, omit_defaults=True):
    """Feedback: the executor's own count, to be compared with the number that it arrives with."""

    count: int
    pad: bytes = b""
    attempt: int = 1


class Done(msgspec.Struct, frozen=True):
    """The result, whole or in part."""

    key: int
    count: int
    pad: bytes = b""


SIMULATED = Action("simulated", goal=Work, feedback=Step, result=Done, checkpoint=int)

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
SUCCEEDING = (
    "takes over",  # takes its successor over as soon as it sees one
    "follows on",  # waits for its successor, and takes it over
    "grasps",  # tries to take its successor over in its clean-up
)
"""More kinds of goals, for schedules."""

ON_PURPOSE = "on purpose"
"""The mark in the text of every error that a scenario wants."""


class SchedulePlan(msgspec.Struct, frozen=True):
    """The schedule of each server of the run; without limits it lets all goals run at once."""

    concurrency: int | None = None
    total: int | None = None
    queue: int = 0
    when_full: Literal["reject", "preempt", "replace"] = "reject"
    keys: int = 0
    """The number of keys; 0 for no function that returns one."""
    urgencies: int = 0
    """The number of different urgencies; 0 for no function that returns one."""
    queue_timeout: float = math.inf
    run_timeout: float = math.inf
    handover: float = 0.0
    fails: bool = False
    """True if the functions fail for some goals."""

    def key_of(self, work: Work) -> int:
        """Return the key of a goal."""
        return work.key % self.keys if self.keys else 0

    def urgency_of(self, work: Work) -> int:
        """Return the urgency of a goal: of the most urgent one the smallest."""
        return work.key * 7 % self.urgencies if self.urgencies else 0

    def schedule(self) -> Schedule:
        """Return the schedule for a server."""

        def key(work: Work) -> int:
            if self.fails and work.key % 7 == 3:
                raise ValueError(ON_PURPOSE)
            return self.key_of(work)

        def priority(work: Work) -> int:
            if self.fails and work.key % 7 == 5:
                raise ValueError(ON_PURPOSE)
            return -self.urgency_of(work)

        return Schedule(
            concurrency=self.concurrency,
            total=self.total,
            queue=self.queue,
            when_full=self.when_full,
            key=key if self.keys else None,
            priority=priority if self.urgencies else None,
            queue_timeout=self.queue_timeout,
            run_timeout=self.run_timeout,
            handover=self.handover,
        )


class StoreFault(msgspec.Struct, frozen=True):
    """A fault of the store, or the death of the process, at a write."""

    what: str
    """The method of the write; empty for any."""
    number: int
    """Number of the write among those of that method, from 1."""
    fate: Fate


class StorePlan(msgspec.Struct, frozen=True):
    """The store of all servers of the run."""

    recovery: Literal["abort", "rerun", "sync", "async"] = "abort"
    max_attempts: int = 3
    at_stop: Literal["abort", "keep"] = "abort"
    delays: tuple[float, ...] = (0.0,)
    """Seconds between a write and its answer, by turns."""
    faults: tuple[StoreFault, ...] = ()
    survivors: int = 0
    """The number of writes under way that are kept in a crash."""
    away: float = 0.0
    """Seconds between the death of a server and the start of the next."""


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
    follows: int = 100
    """The number of times that one connection may follow one goal."""
    requests: int = 1000
    """The number of requests beside goals that one connection may wait for."""
    connections: int = 1000
    asks_for_tokens: bool = False
    """True if clients need a token."""
    schedule: SchedulePlan | None = None
    """The rules by which goals run; None to run all of them at once."""
    store: StorePlan | None = None
    """The store that keeps the goals; None to keep none."""


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


class Attack(msgspec.Struct, frozen=True):
    """One thing that a hostile client does, `count` times."""

    at: float
    """Seconds after the client's start."""
    kind: str
    work: Work
    """The goal of an attack that sends one."""
    count: int = 1
    target: int = 0
    """The index of the first goal that is meant, among those that honest clients have sent."""
    credit: int | None = 0
    """The credit that it grants: none at all, or nil."""
    pause: float = 0.0
    """Seconds for which a silent attack lasts."""


ATTACKS = (
    ("send", 3),  # send goals, and keep them
    ("send again", 2),  # send one goal of its own again and again
    ("copy", 4),  # send goals of others again
    ("clash", 1),  # send other goals with the IDs of others' goals
    ("odd goals", 1),  # goals that are not of the type
    ("follow", 3),  # follow one goal again and again
    ("own", 2),  # follow goals of others as if it had sent them
    ("watch", 2),  # follow the statuses again and again
    ("cancel all", 2),
    ("cancel others", 1),
    ("ask", 2),  # all other requests
    ("forged texts", 2),  # control characters in every text
    ("foreign ids", 2),  # Credit, Close and Received for IDs that are not in use
    ("close", 2),  # Close and Received for all IDs that are in use
    ("credit", 1),  # as much credit as a message can grant
    ("same id", 1),  # a second request with an ID that is in use
    ("hello again", 1),  # a second Hello
    ("hellos", 2),  # connect, say hello, and close
    ("no hello", 4),  # connect, and say nothing
    ("large hello", 2),  # announce a large first message, and send a part of it
    ("no permission to speak", 1),  # begin with a request
    ("garbage", 2),  # random bytes
    ("wrong message", 2),  # a message that a client may not send
    ("half", 2),  # a part of a message, then nothing
    ("too large", 1),  # a message over the limit
    ("odd hello", 2),  # a Hello whose fields are out of their limits
    ("stolen session", 5),  # say hello with the session of another client
)


class HostilePlan(msgspec.Struct, frozen=True):
    """The settings and the attacks of one hostile client."""

    name: str
    weather: Weather
    attacks: tuple[Attack, ...]
    starts_at: float = 0.0
    reads: Literal["all", "slowly", "never"] = "all"
    may: frozenset[Permission] = frozenset(Permission)
    """Its permissions, if the server asks for them."""
    has_token: bool = True
    """False if its token is wrong, where the server asks for one."""
    has_session: bool = True
    heartbeat: float = 1.0
    """Seconds between two messages of it, as it says; it sends one each half second at least."""
    max_frame: int = MAX_FRAME
    leaves: Literal["goodbye", "close", "silence"] = "close"


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
    hostile: tuple[HostilePlan, ...] = ()
    server_at: float = 0.0
    """Seconds until the first server starts."""
    calls_back: bool = False
    """True if connections are asyncio transports, false if they are streams that tasks await."""

    @property
    def has_restarts(self) -> bool:
        """True if the run has several servers, one after the other."""
        return any(fault.kind in ("restart", "crash") for fault in self.faults)

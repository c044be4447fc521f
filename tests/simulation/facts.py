"""The facts of a run: its goals, its servers, and its clients' connections.

`invariants` checks them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from fibaction import GoalID, Outcome
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.words.statuses import INITIAL
from tests.simulation.scenario import ClientPlan, Done, Work

HONEST_TOKEN, HOSTILE_TOKEN = "honest secret", "hostile secret"
"""The tokens of the clients, where the server asks for them."""
EPSILON = 1e-3
"""Seconds between the arrival of a message and its handling: turns of the loop, without latency."""


class Truth:
    """An accepted goal, as its server knows it."""

    def __init__(self, goal_id: GoalID, stamp: int, life: Life, at: float, sender: str) -> None:
        self.goal_id = goal_id
        self.stamp = stamp
        self.sender = sender
        """The name of the client that sent it, as its server knows it."""
        self.life = life
        self.accepted_at = at
        self.statuses = [INITIAL]
        self.goal: GoalRecord | None = None
        """The record of the server."""
        self.attempt = 1
        self.is_restored = False
        """True if an earlier server has accepted it."""
        self.starts = 0
        self.count = 0
        """The number of feedback messages that the executor has yielded."""
        self.result: Done | None = None
        """The result that the executor has yielded."""
        self.outcome: Outcome[Any] | None = None
        self.ended_at = math.inf
        # In the server's schedule:
        self.work = Work(0)
        self.arrival = 0
        """The place in the order of acceptance."""
        self.began_at = math.inf
        """The time at which the goal was given a place to run."""
        self.told_at = math.inf
        """The time from which the goal has had a successor."""
        self.interrupted_at = math.inf
        """The time at which the schedule interrupted the executor."""
        self.stop_reason = ""
        """The reason for which the server ends the goal by itself; empty if it does not."""


class Life:
    """One server, from its start to its stop."""

    def __init__(self, number: int, at: float, owns: Callable[[object], bool]) -> None:
        self.number = number
        self.began_at = at
        self.stops_at = math.inf
        self.is_dead = False
        """True if its process has died: whatever its tasks still do, nobody can see."""
        self.is_orderly = False
        """True if it was stopped, and has had the time to write everything."""
        self.owns = owns
        """The function that says whether a part of the product is this server's."""
        self.goals: dict[tuple[GoalID, int], Truth] = {}
        self.ended: list[Truth] = []
        self.running: list[Truth] = []
        """The goals that have a place to run, until their executors are gone."""
        self.waiting: list[Truth] = []
        self.successors: dict[Truth, Truth] = {}
        """The waiting goals that begin when others, their predecessors, have left."""
        self.next: Truth | None = None
        """The successor of the goal that has left last, until it begins."""
        self.latest: Truth | None = None
        """The goal that was accepted last."""


class ClientState:
    """The state of one client's connection, as seen from outside."""

    def __init__(self, plan: ClientPlan) -> None:
        self.plan = plan
        self.is_ready = False
        self.was_ready = False
        self.has_failed = False
        """True if the last attempt to connect has failed."""
        self.lost_at = math.inf
        self.losses = 0
        self.absent_at = -math.inf
        """The time at which the client last gave up waiting for a connection."""
        self.is_final = False
        self.is_leaving = False
        self.goals: set[GoalID] = set()
        """The goals that the client has sent."""

    def is_absent(self, now: float) -> bool:
        """Return whether its calls may fail because the connection is missing."""
        if self.is_leaving or self.is_final:
            return True
        if self.is_ready:
            return False
        if not self.was_ready:
            return self.has_failed
        return now >= self.lost_at + self.plan.reconnect_timeout - EPSILON


def short(goal_id: GoalID) -> str:
    """Return a short name of a goal for the trace."""
    return f"g{int.from_bytes(goal_id[:4], 'big')}"

"""The facts of a run: its goals, its servers, and its clients' connections.

`invariants` checks them.
"""

from __future__ import annotations

import math
from typing import Any

from fibaction import GoalID, Outcome
from fibaction.states import INITIAL
from tests.simulation.scenario import ClientPlan, Done

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
        self.starts = 0
        self.count = 0
        """The number of feedback messages that the executor has yielded."""
        self.result: Done | None = None
        """The result that the executor has yielded."""
        self.outcome: Outcome[Any] | None = None
        self.ended_at = math.inf


class Life:
    """One server, from its start to its stop."""

    def __init__(self, number: int, at: float, registry: object) -> None:
        self.number = number
        self.began_at = at
        self.stops_at = math.inf
        self.registry = registry
        self.goals: dict[tuple[GoalID, int], Truth] = {}
        self.ended: list[Truth] = []


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

"""What is known of a run: its goals, its servers, and its clients' connections.

Whether that is as it should be is said in `invariants`.
"""

from __future__ import annotations

import math
from typing import Any

from fibaction import GoalID, Outcome
from fibaction.states import INITIAL
from tests.simulation.scenario import ClientPlan, Done

EPSILON = 1e-3
"""Seconds that a message needs to be seen, once it is there: no weather is meant, only turns."""


class Truth:
    """An accepted goal, as its server knows it."""

    def __init__(self, goal_id: GoalID, stamp: int, life: Life, at: float) -> None:
        self.goal_id = goal_id
        self.stamp = stamp
        self.life = life
        self.accepted_at = at
        self.statuses = [INITIAL]
        self.starts = 0
        self.count = 0
        """How much feedback the executor has yielded."""
        self.result: Done | None = None
        """The result that it has yielded."""
        self.outcome: Outcome[Any] | None = None
        self.ended_at = math.inf


class Life:
    """One server, from its start to its stop."""

    def __init__(self, number: int, at: float, protocol: object) -> None:
        self.number = number
        self.began_at = at
        self.stops_at = math.inf
        self.protocol = protocol
        self.goals: dict[tuple[GoalID, int], Truth] = {}
        self.ended: list[Truth] = []


class ClientState:
    """One client's connection, as it was seen from outside."""

    def __init__(self, plan: ClientPlan) -> None:
        self.plan = plan
        self.is_ready = False
        self.was_ready = False
        self.has_failed = False
        """Whether an attempt to connect has failed, and none has succeeded since."""
        self.lost_at = math.inf
        self.losses = 0
        self.absent_at = -math.inf
        """When it was last found that there is no connection, and that nobody waits for one."""
        self.is_final = False
        self.is_leaving = False
        self.goals: set[GoalID] = set()
        """Those that it has sent."""

    def is_absent(self, now: float) -> bool:
        """Whether its calls may fail because there is no connection."""
        if self.is_leaving or self.is_final:
            return True
        if self.is_ready:
            return False
        if not self.was_ready:
            return self.has_failed
        return now >= self.lost_at + self.plan.reconnect_timeout - EPSILON


def short(goal_id: GoalID) -> str:
    """A goal's name in few letters."""
    return f"g{int.from_bytes(goal_id[:4], 'big')}"

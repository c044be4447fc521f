"""Who sends which goal: goal IDs are made up deep inside the product, which knows of no deeds."""

from __future__ import annotations

import math
from contextvars import ContextVar

from fibaction import GoalID
from tests.simulation.invariants import Record
from tests.simulation.scenario import Deed


class Naming:
    """Whose goals are being named, so that it is known who has sent which."""

    def __init__(self, record: Record, client: str, deed: Deed) -> None:
        self._record = record
        self._client = record.clients[client]
        self._deed = deed
        self.losses = self._client.losses
        self.goal_id: GoalID | None = None
        """The goal that the deed is about."""

    def named(self, goal_id: GoalID) -> None:
        """A goal got that ID, and is about to be sent."""
        self.goal_id = goal_id
        self._client.goals.add(goal_id)
        self._record.sent.append((goal_id, self._deed.work))
        if self._deed.patience < math.inf:
            self._record.may_cancel(goal_id)


naming: ContextVar[Naming] = ContextVar("naming")
"""What the running deed names."""

"""The goals of each deed. The product makes goal IDs, and a context variable relates them to the
running deed.
"""

from __future__ import annotations

import math
from contextvars import ContextVar

from fibaction import GoalID
from tests.simulation.invariants import Record
from tests.simulation.scenario import Deed


class GoalNames:
    """The IDs of the goals that one deed sends."""

    def __init__(self, record: Record, client: str, deed: Deed) -> None:
        self._record = record
        self._client = record.clients[client]
        self._deed = deed
        self.losses = self._client.losses
        self.goal_id: GoalID | None = None
        """The goal that the deed is about."""

    def add(self, goal_id: GoalID) -> None:
        """Record the ID of a goal that is about to be sent."""
        self.goal_id = goal_id
        self._client.goals.add(goal_id)
        self._record.sent.append((goal_id, self._deed.work))
        if self._deed.patience < math.inf:
            self._record.may_cancel(goal_id)


goal_names: ContextVar[GoalNames] = ContextVar("goal_names")
"""The goals of the running deed."""

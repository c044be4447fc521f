"""The answers of a scheduler: `Order`s to carry out, and `Busy`."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from fibaction.words.errors import GoalRejected, RejectionCode
from fibaction.words.goals import GoalID


class Act(Enum):
    """A kind of order."""

    START = "start"
    """Run the goal's executor."""
    END = "end"
    """End a goal that has not started, for the reason. It has left already."""
    TELL = "tell"
    """Tell the goal's executor that it has a successor, which it may take over."""
    INTERRUPT = "interrupt"
    """Interrupt the goal's executor for the reason; call `leave` when it has ended."""
    KILL = "kill"
    """Kill the goal's executor, which was interrupted and has not ended in time; call `leave`."""


class Order(NamedTuple):
    """One step that the caller of a scheduler carries out."""

    act: Act
    goal_id: GoalID
    reason: str = ""


class Busy(GoalRejected):
    """A goal can neither run nor wait; the reason says how many do."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason, code=RejectionCode.BUSY)

"""The goal state machine, as one table."""

from fibaction.words.statuses import (
    INITIAL,
    TRANSITIONS,
    GoalEvent,
    GoalStatus,
    InvalidTransition,
    transition,
)

__all__ = [
    "INITIAL",
    "TRANSITIONS",
    "GoalEvent",
    "GoalStatus",
    "InvalidTransition",
    "transition",
]

"""Log records with the goal that they belong to: `GoalFilter`, and `JsonFormatter`."""

from fibaction.observe.log_records import (
    GoalFilter,
    JsonFormatter,
)

__all__ = [
    "GoalFilter",
    "JsonFormatter",
]

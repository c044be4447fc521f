"""A monitor of all actions of a server: their goals, feedback rates and latest feedback."""

from fibaction.observe.monitor import (
    ActionListener,
    ActionSnapshot,
    AnyClient,
    GoalKey,
    GoalSnapshot,
    Monitor,
    Snapshot,
    follow_action,
    follow_actions,
    newest_active_first,
)

__all__ = [
    "ActionListener",
    "ActionSnapshot",
    "AnyClient",
    "GoalKey",
    "GoalSnapshot",
    "Monitor",
    "Snapshot",
    "follow_action",
    "follow_actions",
    "newest_active_first",
]

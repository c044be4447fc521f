"""Goals and journals for the tests of stores."""

from __future__ import annotations

from typing import Any

from fibaction.border.goal_store import StoredGoal
from fibaction.words.goals import GoalID, Sender
from fibaction.words.statuses import GoalStatus


def a_goal(number: int = 1, **fields: Any) -> StoredGoal:
    """Return a goal whose ID and stamp are the number."""
    goal_id = GoalID(number.to_bytes(16, "big"))
    sender = Sender("robot", b"owner", "here")
    fields = {"meta": {"traceparent": f"00-{number}"}, **fields}
    return StoredGoal(goal_id, number, sender, b"digest", b"goal", **fields)


def after_end(goal: StoredGoal, /, **fields: Any) -> StoredGoal:
    """Set the fields of an end, and return the goal, without what was needed only to run it."""
    goal.drop_request()
    goal.status, goal.is_running, goal.ended_at = GoalStatus.SUCCEEDED, False, 5
    goal.result = b"result"
    for name, value in fields.items():
        setattr(goal, name, value)
    return goal

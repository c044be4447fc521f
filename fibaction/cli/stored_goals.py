"""The goals in a store, for `fibaction goals --store`."""

from __future__ import annotations

from fibaction.cli.action_names import shown
from fibaction.cli.goal_table import GoalRow
from fibaction.goals import GoalInfo


async def rows_of_store(path: str, name: str | None) -> list[GoalRow]:
    """Return the goals in the file, of one action or of all, in the order of their acceptance.

    Raises:
        StoreError: The file cannot be read.
    """
    from fibaction.stores._copy import stored_goals  # sqlite3 would slow down --help

    rows = [
        GoalRow(
            action,
            GoalInfo(
                goal.goal_id,
                goal.stamp,
                goal.told_status,
                goal.feedback_count,
                str(goal.sender),
                attempt=max(goal.attempt, 1),
            ),
        )
        for action, goals in (await stored_goals(path)).items()
        if name is None or shown(action) == shown(name)
        for goal in goals
    ]
    return sorted(rows, key=lambda row: row.info.stamp)

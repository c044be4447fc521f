"""The goals in a store, for `fibaction goals --store`."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import msgspec

from fibaction.border.goal_store import StoredGoal
from fibaction.cli.arguments.action_names import shown
from fibaction.cli.output.goal_table import GoalRow
from fibaction.cli.output.outcomes import readable, with_outcome
from fibaction.words.goal_query import GoalQuery
from fibaction.words.goals import Outcome


async def rows_of_store(
    path: str, names: Collection[str], past: GoalQuery | None = None
) -> list[GoalRow]:
    """Return the goals in the file, of these actions or of all, in the order of their acceptance;
    with `past`, also those of its history that are wanted.

    Raises:
        StoreError: The file cannot be read.
    """
    from fibaction.stores._copy import stored_goals  # sqlite3 would slow down --help

    wanted = set(map(shown, names))
    rows = [
        with_outcome(GoalRow(action, goal.info), _outcome(goal))
        for action, goals in (await stored_goals(path, past)).items()
        if not wanted or shown(action) in wanted
        for goal in goals
    ]
    return sorted(rows, key=lambda row: row.info.stamp)


def _outcome(goal: StoredGoal) -> Outcome[Any] | None:
    """Return the outcome of a goal that has ended, its result as plain data."""
    if goal.told_status.is_active:
        return None
    raw = Outcome(goal.told_status, goal.result, goal.reason)
    return readable(raw, msgspec.msgpack.decode)

"""The goals in a file that were given up, as new ones to run again."""

from __future__ import annotations

import time
from contextlib import closing
from copy import copy

from anyio import to_thread

from fibaction._runtime.text import excerpt
from fibaction.border.goal_store import StoredGoal
from fibaction.stores._journal_file import JournalFile
from fibaction.stores.journal_rows import WholeRecord, encode_row
from fibaction.words.errors import StoreError
from fibaction.words.goals import GoalID


async def rerun(path: str, action: str, goal_id: GoalID) -> GoalID:
    """Add a goal to the file of a `SqliteStore` for one that was given up, and return its ID. The
    next server runs it from the checkpoint of the old one, of which only the outcome is kept.

    Raises:
        StoreError: The file is in use or cannot be used, or the goal was not given up.
    """
    return await to_thread.run_sync(_rerun, path, action, goal_id)


def _rerun(path: str, action: str, goal_id: GoalID) -> GoalID:
    failing = f"cannot run goals in {excerpt(path)} again"
    with closing(JournalFile(path, "full", failing=failing)) as file:
        old: StoredGoal | None = file.goals().of(action).ended.get(goal_id)
        if old is None or not old.is_given_up:
            raise StoreError(f"{failing}: goal {goal_id} was not given up")
        new, ended = old.as_new(time.time_ns()), copy(old)
        ended.drop_request()
        records = [WholeRecord(action, new), WholeRecord(action, ended)]
        file.add(encode_row(file.next_number, list(records)))
    return new.goal_id

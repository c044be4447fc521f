"""`SqliteJournal`: the writes of one server to the file of a `SqliteStore`."""

from __future__ import annotations

from copy import copy

from fibaction.border.goal_store import GoalJournal, StoredGoal, Then
from fibaction.stores._writer import Writer
from fibaction.stores.journal_rows import CheckpointRecord, WholeRecord, ended, moved


class SqliteJournal(GoalJournal):
    """The goals of one action in a `SqliteStore` that is open."""

    def __init__(self, action: str, writer: Writer) -> None:
        self._action = action
        self._write = writer.write

    def accept(self, goal: StoredGoal, then: Then) -> None:
        # A copy: the goal continues while it waits for the thread.
        self._write(WholeRecord(self._action, copy(goal)), then)

    def begin(self, goal: StoredGoal, then: Then) -> None:
        self._write(moved(self._action, goal), then)

    def cancel(self, goal: StoredGoal, then: Then) -> None:
        self._write(moved(self._action, goal), then)

    def checkpoint(self, goal: StoredGoal, then: Then) -> None:
        self._write(CheckpointRecord(self._action, goal.goal_id, goal.checkpoint), then)

    def end(self, goal: StoredGoal, then: Then) -> None:
        self._write(ended(self._action, goal), then)

    def release(self, goal: StoredGoal, then: Then) -> None:
        self._write(moved(self._action, goal), then)

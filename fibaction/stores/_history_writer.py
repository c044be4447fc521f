"""The writes and the reads of a server whose store has a history: see `_history_table`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy

from fibaction._runtime.log import clean_logger
from fibaction.border.goal_store import StoredGoal, Then
from fibaction.stores._history_table import HistoryTable
from fibaction.stores._journal_file import JournalFile
from fibaction.stores._writer import Batch, SqliteJournal, Writer
from fibaction.stores.journal_rows import EndRecord
from fibaction.words.goal_history import GoalHistory
from fibaction.words.goal_query import MOST_PAST, PastPage, Place
from fibaction.words.goals import GoalID, GoalInfo

logger = clean_logger("fibaction.server")


class HistoryWriter(Writer):
    """A thread that also writes the history."""

    def __init__(self, path: str, sync: str, bounds: GoalHistory) -> None:
        self._bounds = bounds
        self._table: HistoryTable
        self._is_full = False
        super().__init__(path, sync)

    async def part(self, action: str, page: PastPage) -> tuple[list[GoalInfo], Place | None]:
        """See `HistoryTable.part`.

        Raises:
            StoreError: It cannot be read.
        """
        return await self._ask(lambda: self._table.part(action, page))

    async def find(self, action: str, goal_id: GoalID) -> StoredGoal | None:
        """See `HistoryTable.find`.

        Raises:
            StoreError: It cannot be read.
        """
        return await self._ask(lambda: self._table.find(action, goal_id))

    # In the thread

    def _open(self) -> None:
        super()._open()
        assert self._file is not None
        self._table = HistoryTable(self._file, self._bounds)

    def _add_row(self, file: JournalFile, row: bytes, batch: Batch) -> None:
        ends = [
            (record.action, past)
            for record, _, past in batch
            if past is not None and isinstance(record, EndRecord)
        ]
        if not ends:
            super()._add_row(file, row, batch)
        elif not self._table.add(row, ends) and not self._is_full:
            self._is_full = True
            logger.warning(
                "the disk has no room for the history in %s: goals that end now may be missing in"
                " it",
                self._path,
            )

    def _clean(self) -> None:
        super()._clean()
        self._table.prune()


class HistoryJournal(SqliteJournal):
    """The goals of one action in a store that has a history."""

    def __init__(
        self,
        action: str,
        writer: HistoryWriter,
        claim: Callable[[StoredGoal], None],
        goals: Sequence[StoredGoal],
    ) -> None:
        """Write to a file that has these goals."""
        super().__init__(action, writer, self._claim_again, goals)
        self._claim_goal = claim
        self._writer = writer
        active = (goal for goal in goals if goal.status.is_active)
        self._sent = {goal.goal_id: (goal.goal, goal.meta) for goal in active}
        """The request and the meta of each active goal, which it does not have at its end."""

    def _claim_again(self, goal: StoredGoal) -> None:
        self._sent[goal.goal_id] = goal.goal, goal.meta
        self._claim_goal(goal)

    def accept(self, goal: StoredGoal, then: Then) -> None:
        self._sent[goal.goal_id] = goal.goal, goal.meta
        super().accept(goal, then)

    def end(self, goal: StoredGoal, then: Then) -> None:
        past = copy(goal)
        past.goal, past.meta = self._sent.pop(goal.goal_id, (goal.goal, goal.meta))
        past.checkpoint = None
        self._write_end(goal, then, past)

    async def past_goals(self, page: PastPage) -> list[GoalInfo]:
        found: list[GoalInfo] = []
        limit = min(page.limit, MOST_PAST)
        after: Place | None = page.after
        while len(found) < limit:
            left = page._replace(limit=limit - len(found), after=after)
            more, after = await self._writer.part(self._action, left)
            found += more
            if after is None:
                break
        return found

    async def past_goal(self, goal_id: GoalID) -> StoredGoal | None:
        return await self._writer.find(self._action, goal_id)

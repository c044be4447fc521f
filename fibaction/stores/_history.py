"""The history in a journal's file: a table of goals that have ended, and what uses it.

Theory of operation
-------------------

The journal forgets an ended goal when its outcome need not be kept any longer. With a `GoalHistory`
the end of a goal also adds a row to the table `history`, in the same commit as its record in the
journal, so a kill leaves both or none. The table then depends on the journal no more.

A row has the goal twice. `line` is what a list tells of it, some hundred bytes. `whole` is all of
it, with the request and the result. It is the last column, so SQLite reads the pages of a large one
only when that goal is asked for. Both have the form and the checksum of a row of the journal; one
that is not what was written is left out, since a list without it is better than none.

Rows are numbered in the order of the ends, so the first ones are the oldest. After each commit some
more of them may be deleted than were added, in a commit of their own, after the clients were told.
At the start all rows that are too old or too many are deleted, in several commits. A row that is
too old is never shown, whether it is deleted yet or not.

A page of a list is read in parts of `SCANNED` rows, each a command of its own for the thread, so a
commit waits for one part at most. A part begins after the place of the row before, by the index of
stamps.

A full disk must not stop the server because of its history: a commit that has no room is tried once
more without the history, and a delete that has no room is tried again later.

A file without the table gets it when it is opened with a history. A release that does not know the
table leaves it as it is.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Sequence
from copy import copy
from functools import partial
from typing import TypeAlias

from fibaction._runtime.log import clean_logger
from fibaction.border.goal_store import StoredGoal, Then
from fibaction.stores._journal_file import JournalFile
from fibaction.stores._wal import PAGE
from fibaction.stores._writer import Batch, SqliteJournal, Writer
from fibaction.stores.journal_rows import DamagedRow, EndRecord, WholeRecord, decode_row, encode_row
from fibaction.words.goal_query import MOST_PAST, GoalHistory, GoalQuery, PastPage, Place
from fibaction.words.goals import GoalID, GoalInfo

TABLE = """
create table if not exists history(
    n integer primary key,
    action text not null,
    stamp integer not null,
    goal_id blob not null,
    ended_at integer not null,
    line blob not null,
    whole blob not null
)
"""
BY_STAMP = "create index if not exists history_by_stamp on history(action, stamp, goal_id)"
BY_ID = "create index if not exists history_by_id on history(goal_id)"
SCANNED = 256
"""Rows of a list that are read at once, which takes some milliseconds."""
DELETED = 200
"""Rows that are deleted in one commit at the start."""
MORE = 20
"""Rows that a commit may delete beside as many as it has added."""
PAGES = 3
"""Pages that a row changes: of the table, and of each index."""
Row: TypeAlias = tuple[int, str, int, bytes, int, bytes, bytes]
LAST_STAMP = 2**63 - 1
FIRST_PLACE: Place = (-1, b"")
LAST_PLACE: Place = (LAST_STAMP, b"\xff" * 17)


class HistoryTable:
    """The table in an open file. Each method can raise a StoreError."""

    def __init__(self, file: JournalFile, bounds: GoalHistory) -> None:
        """Make the table if there is none, and delete what is out of bounds."""
        self._file = file
        self._bounds = bounds
        file.write(_make)
        self._last, self._count, self._oldest_end = file.look(_numbers)
        self._added = 0
        while self._prune(DELETED):
            pass

    def add(self, row: bytes, ends: list[tuple[str, StoredGoal]]) -> bool:
        """Add a row to the journal, and the goals of actions whose end it tells to the history.

        Return whether there was room for both; else the row alone was added.
        """
        if not self._file.add_with(row, partial(self._insert, ends)):
            return False
        self._oldest_end = self._oldest_end if self._count else ends[0][1].ended_at
        self._last += len(ends)
        self._count += len(ends)
        self._added += len(ends)
        return True

    def _insert(self, ends: list[tuple[str, StoredGoal]], db: sqlite3.Connection) -> int:
        rows = [
            _row(number, action, goal) for number, (action, goal) in enumerate(ends, self._last + 1)
        ]
        db.executemany("insert into history values (?, ?, ?, ?, ?, ?, ?)", rows)
        return len(rows) * PAGES * PAGE + sum(len(row[-1]) for row in rows)

    def prune(self) -> None:
        """Delete some rows that are out of bounds, as many as were added and some more at most."""
        self._prune(self._added + MORE)
        self._added = 0

    def _prune(self, most: int) -> bool:
        """Delete up to so many rows that are out of bounds; return whether there may be more."""
        earliest = self._bounds.earliest_end(time.time_ns())
        if not self._count or (self._count <= self._bounds.goals and self._oldest_end > earliest):
            return False
        gone: list[tuple[int]] = []
        if not self._file.write(partial(self._delete, most, earliest, gone)):
            return False
        self._count -= len(gone)
        self._oldest_end = self._file.look(_oldest_end)
        return bool(gone)

    def _delete(
        self, most: int, earliest: int, gone: list[tuple[int]], db: sqlite3.Connection
    ) -> int:
        rows = db.execute("select n, ended_at from history order by n limit ?", (most,))
        excess = self._count - self._bounds.goals
        for place, (number, ended_at) in enumerate(rows.fetchall()):
            if place < excess or ended_at <= earliest:
                gone.append((number,))
        db.executemany("delete from history where n = ?", gone)
        return len(gone) * PAGES * PAGE

    def part(self, action: str, page: PastPage) -> tuple[list[GoalInfo], Place | None]:
        """Return the goals of a page that the next rows have, and the place of the last row; None
        if there are no more rows.
        """
        rows = self._file.look(partial(_select, action, page))
        earliest = self._bounds.earliest_end(time.time_ns())
        found: list[GoalInfo] = []
        for number, stamp, goal_id, line in rows:
            info = _info_in(number, line)
            if info is not None and (info.ended_at or 0) > earliest and page.wanted.has(info):
                found.append(info)
                if len(found) == page.limit:
                    return found, (stamp, goal_id)
        return found, (rows[-1][1], rows[-1][2]) if len(rows) == SCANNED else None

    def find(self, action: str, goal_id: GoalID) -> StoredGoal | None:
        """Return a goal with its request and its result; None if there is none of that ID."""
        rows = self._file.look(partial(_select_whole, action, goal_id))
        earliest = self._bounds.earliest_end(time.time_ns())
        for number, whole in rows:
            goal = _goal_in(number, whole)
            if goal is not None and goal.ended_at > earliest:
                return goal
        return None


def past_in(file: JournalFile, wanted: GoalQuery) -> dict[str, list[StoredGoal]]:
    """Return the goals of the history in a file that are wanted, by the names of their actions, in
    the order of their ends and without their requests. A file without a history has none.
    """
    return file.look(partial(_wanted_past, wanted))


def _make(db: sqlite3.Connection) -> int:
    for statement in (TABLE, BY_STAMP, BY_ID):
        db.execute(statement)
    return 0


def _numbers(db: sqlite3.Connection) -> tuple[int, int, int]:
    last, count = db.execute("select coalesce(max(n), 0), count(*) from history").fetchone()
    return last, count, _oldest_end(db)


def _oldest_end(db: sqlite3.Connection) -> int:
    """Return the time of the end in the first row; 0 without rows."""
    return (db.execute("select ended_at from history order by n limit 1").fetchone() or (0,))[0]


def _row(number: int, action: str, goal: StoredGoal) -> Row:
    whole = copy(goal)
    whole.reason = goal.reason.encode(errors="replace").decode()  # as `journal_rows.ended` does
    return (
        number,
        action,
        goal.stamp,
        goal.goal_id,
        goal.ended_at,
        encode_row(number, [WholeRecord(action, whole.listed())]),
        encode_row(number, [WholeRecord(action, whole)]),
    )


def _select(
    action: str, page: PastPage, db: sqlite3.Connection
) -> list[tuple[int, int, bytes, bytes]]:
    """Return the next rows of a page."""
    since, until = (_stamp(page.wanted.since, 0), _stamp(page.wanted.until, LAST_STAMP))
    if page.newest_first:
        # One bound at each end: of two, SQLite might begin at the farther one, and skip the rest.
        begin = min(page.after or LAST_PLACE, (until, LAST_PLACE[1]))
        where, order = "(stamp, goal_id) < (?, ?) and stamp >= ?", "desc"
        end = since
    else:
        begin = max(page.after or FIRST_PLACE, (since, b""))
        where, order = "(stamp, goal_id) > (?, ?) and stamp <= ?", "asc"
        end = until
    return db.execute(
        f"select n, stamp, goal_id, line from history where action = ? and {where}"
        f" order by stamp {order}, goal_id {order} limit ?",
        (action, min(begin[0], LAST_STAMP), begin[1], end, SCANNED),
    ).fetchall()


def _stamp(time_asked: int | None, otherwise: int) -> int:
    """Return a time of a query as a number that SQLite takes."""
    return otherwise if time_asked is None else min(max(time_asked, 0), LAST_STAMP)


def _select_whole(action: str, goal_id: GoalID, db: sqlite3.Connection) -> list[tuple[int, bytes]]:
    return db.execute(
        "select n, whole from history where goal_id = ? and action = ? order by n desc limit 1",
        (bytes(goal_id), action),
    ).fetchall()


def _wanted_past(wanted: GoalQuery, db: sqlite3.Connection) -> dict[str, list[StoredGoal]]:
    found: dict[str, list[StoredGoal]] = {}
    if db.execute("select 1 from sqlite_master where name = 'history'").fetchone() is None:
        return found
    for number, action, whole in db.execute("select n, action, whole from history order by n"):
        goal = _goal_in(number, whole)
        if goal is not None and wanted.at(action).has(goal.info):
            goal.goal = b""  # it may be large, and there may be many
            found.setdefault(action, []).append(goal)
    return found


def _info_in(number: int, row: bytes) -> GoalInfo | None:
    goal = _goal_in(number, row)
    return None if goal is None else goal.info


def _goal_in(number: int, row: bytes) -> StoredGoal | None:
    """Return the goal in a row; None if the row is not what was written."""
    try:
        [record] = decode_row(number, row)
    except DamagedRow:
        return None
    assert isinstance(record, WholeRecord)
    return record.goal


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

"""The thread that writes a journal, between an event loop and a file.

Theory of operation
-------------------

The event loop puts records into a queue, each with the function to call when it is durable: at the
end of a turn all that were written in it, since the thread would commit the first of them alone.
The thread takes all records that came while it wrote the last ones, and writes them as one row in
one commit; then one call in the event loop tells the end of all of them, in order. So a commit
takes as long as the disk needs, and the more goals are under way, the more of them share it. The
thread does little else, since each time it needs the interpreter it waits for a busy event loop.
One row for each goal would need neither records nor compaction, but more of both: with it, 100 and
500 goals at once reached 0.4 of the rate in memory, and with one row for each commit 0.65
(`python -m tests.tools.benchmarks.durable --rates inproc`); one goal at a time was the same.

Commands, to read goals for example, are in the same queue: each comes after all records before it.

The first write that fails is the last one: the disk may have lost what it said it had (no call of
`fsync` after a failed one can be trusted), so that record and all later ones get a StoreError.

The queue holds as much as the goals that are under way: each of them waits for its write before the
next. The thread is a daemon: a program that ends without closing its store is not held up.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from copy import copy
from functools import partial
from queue import SimpleQueue
from threading import Thread
from typing import TYPE_CHECKING, TypeAlias, TypeVar

import anyio
from anyio import CancelScope, Lock

from fibaction._runtime.text import excerpt
from fibaction.border.event_loop import asyncio_task
from fibaction.border.goal_store import GoalJournal, StoredGoal, Then
from fibaction.stores.journal_rows import (
    CheckpointRecord,
    KeptGoals,
    Record,
    WholeRecord,
    encode_row,
    ended,
    moved,
)
from fibaction.words.errors import StoreError
from fibaction.words.goals import GoalID

if TYPE_CHECKING:
    import sqlite3

    from fibaction.stores._journal_file import JournalFile  # imports sqlite3

INTAKES = """
create table if not exists intakes(action text primary key, kept blob not null) without rowid
"""
COMPACT_FROM = 8 * 1024 * 1024
"""Bytes of rows below which a journal is not compacted while it is in use."""
GROWTH = 4
"""The journal is compacted when it has this many times the bytes that its goals had."""
LARGEST_ROW = 64 * 1024 * 1024
"""Bytes of a row above which its records are written in two."""

FoundT = TypeVar("FoundT")

Call: TypeAlias = Callable[..., object]
"""A function that has another one called on the event loop, with arguments."""
Batch: TypeAlias = list[tuple[Record, Then, StoredGoal | None]]
"""Records, each with the function to call, and with the goal if its end is also for a history."""


def loop_callers() -> tuple[Call, Call]:
    """Return the `Call`s of the event loop that runs the caller: for itself, and for threads."""
    task = asyncio_task()
    if task is not None:
        loop = task.get_loop()
        return loop.call_soon, loop.call_soon_threadsafe
    import trio

    call = trio.lowlevel.current_trio_token().run_sync_soon
    return call, call


class Writer:
    """A thread that writes a journal for one event loop, from its creation until `close`."""

    def __init__(self, path: str, sync: str) -> None:
        """Start the thread. The file is opened there, and its error is that of each command."""
        self._path, self._sync = path, sync
        self._call_soon, self._call = loop_callers()
        self._written: Batch = []
        self._queue: SimpleQueue[Batch | _WriterCommand] = SimpleQueue()
        self._is_closing = False
        self._turn = Lock()
        self._file: JournalFile | None = None
        self._has_begun = False
        self._max_results: dict[str, int] = {}
        self._error = ""
        self._thread = Thread(target=self._run, name="fibaction store", daemon=True)
        self._thread.start()

    def write(self, record: Record, then: Then, past: StoredGoal | None = None) -> None:
        """Write a record; `then` is called on the event loop when it is durable or has failed."""
        if self._is_closing:
            self._call_soon(then, self._closed())
            return
        self._written.append((record, then, past))
        if len(self._written) == 1:
            self._call_soon(self._flush)

    def _closed(self) -> StoreError:
        return StoreError(f"the store {excerpt(self._path)} is closed")

    def _flush(self) -> None:
        """Give the thread what this turn of the event loop has written."""
        if self._written:
            self._queue.put(self._written)
            self._written = []

    async def load(self, action: str, max_results: int) -> list[StoredGoal]:
        """Return the goals of an action, in the order in which a server takes them.

        Raises:
            StoreError: The file cannot be opened, or a write has failed.
        """
        goals: list[StoredGoal] = []
        if error := await self._do(partial(self._load, action, max_results, goals)):
            raise StoreError(error)
        return goals

    async def change_intake(self, action: str, change: Callable[[bytes], bytes]) -> bytes:
        """See `IntakeSource.change_intake`.

        Raises:
            StoreError: It cannot be kept.
        """
        kept: list[bytes] = []
        if error := await self._do(partial(self._change_intake, action, change, kept)):
            raise StoreError(error)
        if not kept:  # which the next goal will be told, too: the store has not failed
            raise StoreError(f"the disk has no room for the intake in {excerpt(self._path)}")
        return kept[0]

    async def rerun(self, action: str, goal_id: GoalID) -> StoredGoal | None:
        """Add a goal to the file for one that was given up, and return it; None if it was not.

        Raises:
            StoreError: A write has failed.
        """
        added: list[StoredGoal | None] = []
        if error := await self._do(partial(self._rerun, action, goal_id, added)):
            raise StoreError(error)
        return added.pop()  # the thread has the list until its next command

    async def given_up(self, action: str, goal_id: GoalID) -> StoredGoal | None:
        """Return a goal in the file that was given up; None if there is none of that ID.

        Raises:
            StoreError: The file cannot be read.
        """
        return await self._ask(lambda: self._goals().of(action).given_up(goal_id))

    async def finish(self, action: str) -> None:
        """Wait until everything that was written is told; the action is no longer open."""
        await self._do(partial(self._max_results.pop, action, None))

    async def close(self) -> None:
        """Wait until everything that was written is told, then close the file."""
        self._is_closing = True
        await self._do(None)
        self._thread.join()  # it has nothing left to do

    async def _do(self, work: Callable[[], object] | None) -> str:
        command = _WriterCommand(work)
        self._flush()
        self._queue.put(command)
        await command.is_done.wait()
        return command.error

    async def _ask(self, look: Callable[[], FoundT]) -> FoundT:
        """Return what a function finds. Its error ends no write: later ones go on."""
        answers: list[FoundT] = []
        errors: list[StoreError] = []

        def work() -> None:
            try:
                answers.append(look())
            except StoreError as exc:
                errors.append(exc)

        async with self._turn:  # one at a time, so that a commit waits for one of them at most
            if self._is_closing:
                raise self._closed()
            failed = await self._do(work)
        if failed:
            raise StoreError(failed)
        for error in errors:
            raise error
        return answers.pop()  # the thread has the list until its next command

    # All that follows runs in the thread.

    def _run(self) -> None:
        last = None
        try:
            self._try(self._open)
            while last is None:
                # Those that come meanwhile are for the next commit.
                items = [self._queue.get()]
                items += [self._queue.get_nowait() for _ in range(self._queue.qsize())]
                last = self._handle(items)
        except RuntimeError:
            pass  # the event loop has ended without closing the store: there is nothing to tell
        if self._file is not None:
            self._file.close()
        if last is not None:
            with suppress(RuntimeError):  # the event loop has ended meanwhile
                self._call(last.is_done.set)

    def _handle(self, items: list[Batch | _WriterCommand]) -> _WriterCommand | None:
        """Do everything in order; return the command to close, after which nothing comes."""
        batch: Batch = []
        for item in items:
            if isinstance(item, list):
                batch += item
                item.clear()  # the event loop is the last that has them: see `_tell`
                continue
            self._commit(batch)
            batch = []
            if item.work is None:
                return item
            self._try(item.work)
            item.error = self._error
            self._call(item.is_done.set)
        self._commit(batch)
        return None

    def _commit(self, batch: Batch) -> None:
        if batch:
            self._try(partial(self._add, batch))
            self._call(_tell, batch, self._error)
            self._try(self._clean)

    def _try(self, work: Callable[[], object]) -> None:
        """Do this work, unless an earlier one has failed; note the text of its error."""
        if not self._error:
            try:
                work()
            except StoreError as exc:
                self._error = str(exc)
            except Exception as exc:
                self._error = excerpt(
                    f"cannot keep goals in {self._path}: {type(exc).__name__}: {exc}", 400
                )

    def _open(self) -> None:
        from fibaction.stores._journal_file import JournalFile  # the import takes its time

        self._file = JournalFile(self._path, self._sync)

    def _add(self, batch: Batch) -> None:
        assert self._file is not None
        row = encode_row(self._file.next_number, [record for record, *_ in batch])
        if len(row) > LARGEST_ROW and len(batch) > 1:
            half = len(batch) // 2
            self._add(batch[:half])
            self._add(batch[half:])
        else:
            self._add_row(self._file, row, batch)

    def _add_row(self, file: JournalFile, row: bytes, batch: Batch) -> None:
        """Add the row of a batch to the file."""
        file.add(row)

    def _load(self, action: str, max_results: int, found: list[StoredGoal]) -> None:
        assert self._file is not None
        self._max_results[action] = max_results
        goals = self._goals()
        if not self._has_begun:
            self._file.replace(goals.rows(self._file.next_number))
            self._has_begun = True
        found += goals.of(action).in_order()

    def _change_intake(
        self, action: str, change: Callable[[bytes], bytes], kept: list[bytes]
    ) -> None:
        from fibaction.stores._wal import PAGE

        assert self._file is not None

        def write(db: sqlite3.Connection) -> int:
            db.execute(INTAKES)
            row = db.execute("select kept from intakes where action = ?", (action,)).fetchone()
            kept.append(change(b"" if row is None else row[0]))
            if row is None or row[0] != kept[0]:
                db.execute("insert or replace into intakes values (?, ?)", (action, kept[0]))
            return len(kept[0]) + PAGE

        if not self._file.write(write):
            kept.clear()

    def _rerun(self, action: str, goal_id: GoalID, added: list[StoredGoal | None]) -> None:
        from fibaction.stores._journal_file import add_again

        assert self._file is not None
        added.append(add_again(self._file, self._goals(), action, goal_id))

    def _clean(self) -> None:
        """Make the file smaller, if need be, after the clients were told."""
        assert self._file is not None
        if self._file.size > max(COMPACT_FROM, GROWTH * self._file.first_size):
            self._file.replace(self._goals().rows(self._file.next_number))

    def _goals(self) -> KeptGoals:
        """Return the goals in the file, without those that the open actions can forget."""
        assert self._file is not None
        goals = self._file.goals()
        now = time.time_ns()
        for action, max_results in self._max_results.items():
            goals.of(action).drop_expired(max_results, now)
        return goals


class _WriterCommand:
    """Something that the thread is to do between its writes; to close, if it is None."""

    def __init__(self, work: Callable[[], object] | None) -> None:
        self.work = work
        self.is_done = anyio.Event()
        self.error = ""


def _tell(batch: Batch, error: str) -> None:
    """Call the function of each record, on the event loop, and let go of them there: each holds a
    goal, whose end is counted where no other thread counts.
    """
    try:
        for _, then, _ in batch:
            then(StoreError(error) if error else None)
    finally:
        batch.clear()


class SqliteJournal(GoalJournal):
    """The goals of one action in a `SqliteStore` that is open."""

    def __init__(
        self,
        action: str,
        writer: Writer,
        claim: Callable[[StoredGoal], None],
        goals: Iterable[StoredGoal],
    ) -> None:
        """Write to a file that has these goals."""
        self._action = action
        self._claim = claim
        self._given_up = {GoalID(goal.goal_id) for goal in goals if goal.is_given_up}
        """The goals that may have been given up: all others need not be looked for in the file."""
        self._find_given_up = partial(writer.given_up, action)
        self._add_again = partial(writer.rerun, action)
        self._write = writer.write
        self._change_intake = partial(writer.change_intake, action)

    def accept(self, goal: StoredGoal, then: Then) -> None:
        # A copy: the goal continues while it waits for the thread.
        self._write(WholeRecord(self._action, copy(goal)), then)

    def begin(self, goal: StoredGoal, then: Then) -> None:
        self._write(moved(self._action, goal), then)

    cancel = release = begin

    def checkpoint(self, goal: StoredGoal, then: Then) -> None:
        self._write(CheckpointRecord(self._action, goal.goal_id, goal.checkpoint), then)

    def end(self, goal: StoredGoal, then: Then) -> None:
        self._write_end(goal, then)

    def _write_end(self, goal: StoredGoal, then: Then, past: StoredGoal | None = None) -> None:
        if goal.is_given_up:
            self._given_up.add(GoalID(goal.goal_id))
        self._write(ended(self._action, goal), then, past)

    async def intake(self) -> bytes:
        return await self._change_intake(lambda kept: kept)

    async def change_intake(self, change: Callable[[bytes], bytes]) -> bytes:
        return await self._change_intake(change)

    async def given_up(self, goal_id: GoalID) -> StoredGoal | None:
        if goal_id not in self._given_up:
            return None
        goal = await self._find_given_up(goal_id)
        if goal is None:  # it runs again, or is not kept any more
            self._given_up.discard(goal_id)
        return goal

    async def rerun(self, goal_id: GoalID) -> GoalID | None:
        new: StoredGoal | None = None
        with CancelScope(shield=True):  # a goal that is in the file is also to run
            new = await self._add_again(goal_id)
        if new is None:
            return None
        self._claim(new)
        return new.goal_id

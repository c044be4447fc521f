"""`SqliteStore`: goals in a file, by the SQLite of Python's standard library."""

from __future__ import annotations

import os
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from threading import get_ident
from typing import TYPE_CHECKING, Literal

from anyio import CancelScope, Event

from fibaction._runtime.text import excerpt
from fibaction.border.event_loop import Slices
from fibaction.border.goal_store import GoalJournal, GoalStore, StoredGoal, no_obstacle
from fibaction.words.errors import StoreError
from fibaction.words.goal_query import GoalHistory, check_is_history
from fibaction.words.goals import GoalID

if TYPE_CHECKING:
    from fibaction.stores._writer import Writer


class SqliteStore(GoalStore):
    """A store in one file, for all servers of one process.

    The file is made if there is none. It is locked while a server uses it, and a second process
    gets a StoreError. The goals of actions that are not served stay as they are. Next to the file
    there are one or two more while it is in use; a copy needs all of them.

    The file is on a disk of this machine, since network file systems do not lock reliably.

    With a `GoalHistory`, goals that have ended stay in the file beyond the time for which their
    server remembers them, and are in lists of the past.

    For example:

        ActionServer(PRINT, print_layers, store=SqliteStore("goals.db"), recovery="rerun")
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        sync: Literal["full", "normal"] = "full",
        *,
        history: GoalHistory | None = None,
    ) -> None:
        """Name the file; it is opened when a server starts.

        With `sync="full"`, what a client was told is kept even when the power fails, as far as the
        disk keeps what it says it does. With `"normal"` it is kept when the process ends in any
        way, but the last moments before a power failure can be lost; a write is then ready sooner.

        `history` says how long goals are kept after their end; None to keep only what clients may
        still ask for.

        Raises:
            TypeError: `history` is not a `GoalHistory`.
            ValueError: `sync` is neither of the two, or the path does not name a file.
        """
        check_is_history(history)
        if sync not in ("full", "normal"):
            raise ValueError(f"sync must be 'full' or 'normal', not {sync!r}")
        name: str = os.fsdecode(path)
        if name == ":memory:":
            raise ValueError("a store is a file: leave `store` out to keep goals in memory")
        # SQLite puts its other files next to the file itself, and not next to a link to it.
        self._path: str = os.path.realpath(name)
        self._sync = sync
        self._history = history
        self._writer: Writer | None = None
        self._thread = 0
        self._users = 0
        self._actions: set[str] = set()
        self._closing: Event | None = None

    def __repr__(self) -> str:
        history = "" if self._history is None else f", history={self._history!r}"
        return f"SqliteStore({self._path!r}, sync={self._sync!r}{history})"

    @asynccontextmanager
    async def open(
        self,
        action: str,
        *,
        max_results: int,
        claim: Callable[[StoredGoal], None],
        lose: Callable[[GoalID], None],
        obstacle: Callable[[StoredGoal], str] = no_obstacle,
        ends_unreadable: bool = False,
    ) -> AsyncGenerator[GoalJournal, None]:
        writer = await self._begin(action)
        try:
            slices = Slices()
            goals = await writer.load(action, max_results)
            journal = self._journal(action, writer, claim, goals)
            for goal in goals:
                claim(goal)
                await slices.pause()
            del goals
            yield journal
        finally:
            with CancelScope(shield=True):
                await self._end(action, writer)

    async def _begin(self, action: str) -> Writer:
        """Return the thread that writes; the first action starts it."""
        if self._writer is not None and self._thread != get_ident():
            raise self._error("it is in use by the event loop of another thread")
        while self._closing is not None:
            await self._closing.wait()
        if action in self._actions:
            raise self._error(f"a server of the action {excerpt(action)!r} uses it already")
        if self._writer is None:
            self._writer, self._thread = self._new_writer(), get_ident()
        self._users += 1
        self._actions.add(action)
        return self._writer

    # The imports take their time, which only programs with a store are to pay.

    def _new_writer(self) -> Writer:
        if self._history is None:
            from fibaction.stores._writer import Writer

            return Writer(self._path, self._sync)
        from fibaction.stores._history import HistoryWriter

        return HistoryWriter(self._path, self._sync, self._history)

    def _journal(
        self,
        action: str,
        writer: Writer,
        claim: Callable[[StoredGoal], None],
        goals: list[StoredGoal],
    ) -> GoalJournal:
        if self._history is None:
            from fibaction.stores._writer import SqliteJournal

            return SqliteJournal(action, writer, claim, goals)
        from fibaction.stores._history import HistoryJournal, HistoryWriter

        assert isinstance(writer, HistoryWriter)
        return HistoryJournal(action, writer, claim, goals)

    async def _end(self, action: str, writer: Writer) -> None:
        """Wait for the writes that are under way; the last action ends the thread."""
        self._users -= 1
        closing = None if self._users else Event()
        try:
            if closing is None:
                await writer.finish(action)
            else:
                self._closing = closing
                await writer.close()
        finally:  # asyncio can cancel the task itself; the thread then closes the file by itself
            if closing is not None:
                self._writer = self._closing = None
                closing.set()
            self._actions.remove(action)

    def _error(self, reason: str) -> StoreError:
        return StoreError(f"cannot keep goals in {excerpt(self._path)}: {reason}")

"""`GoalKeeper`: the server's side of its store, through which it writes about its goals, in order.

Theory of operation
-------------------

The keeper makes the `StoredGoal` of a goal when it is accepted, brings it up to date at each step,
and hands it to the journal of the store. Each write has a number. The store answers the writes in
their order, from any code on the event loop; one task, `run`, then calls the functions that were
given with the writes, so that they run as in any other task, and in slices. What is to be told only
when it is kept, is told by such a function; `kept` and `settled` wait for writes.

The first write that fails is the end: nothing was told about it, nothing is written any more, and
`on_failure` stops the server. What is too large for the store concerns its goal alone: a function
that was given with the write rejects or ends the goal.

A goal that belongs to another server by now is lost for this one alone: a write of it is refused
(`on_refused`), or the store says so by itself (`on_lost`). Both happen at once, and overtake the
answers that wait: those about a lost goal change nothing any more. The same goal may come back as
another record, so a refusal is about a record, and not about an ID.

Without a store, a server has a `NoStoreKeeper`.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from functools import partial
from heapq import heappop, heappush
from typing import NamedTuple

from anyio import current_time

from fibaction._runtime.log import clean_logger
from fibaction._runtime.notify import Notifier
from fibaction._runtime.slices import Slices
from fibaction.border.goal_store import (
    GoalJournal,
    GoalStore,
    GoalTaken,
    RecordTooLarge,
    StoredGoal,
    Then,
)
from fibaction.server.durability.keeper import Keeper, Kept, TooLarge
from fibaction.server.life import Event, Phase
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.words.errors import GoalKept, StoreError, copy_of
from fibaction.words.goals import GoalID, Outcome
from fibaction.words.statuses import GoalStatus

OUTCOME_GRACE = 60.0
"""Seconds for which a store keeps an outcome beyond the result timeout: the client may have waited
for it while the server was away."""

GOAL_IS_TAKEN = "another server has taken the goal over"
STORE_FAILED = "the server has stopped, because its store has failed"
STORE_IS_LATE = "the server has stopped before its store has answered"

SECOND = 1_000_000_000
LONGEST = 1e9
"""Seconds above which a time is kept as unlimited: some 30 years."""

logger = clean_logger("fibaction.server")


class _Answer(NamedTuple):
    """The answer of the store to a write."""

    goal: GoalRecord
    then: Callable[[], None] | None
    too_large: Callable[[RecordTooLarge], None] | None
    error: StoreError | None


class GoalKeeper(Keeper):
    """The writes of one server to its store."""

    def __init__(self, store: GoalStore, action: str, *, keep_for: float, max_results: int) -> None:
        """Keep outcomes for so many seconds, and so many of them at most."""
        self._store = store
        self._action = action
        self._keep_for = keep_for
        self._max_results = max_results
        self._journal: GoalJournal
        self._written = 0
        self._answered = 0
        self._answers: deque[_Answer] = deque()
        self._news = Notifier()
        self._too_large: dict[int, RecordTooLarge] = {}  # by the numbers of checkpoints
        self._waits: list[tuple[int, int, Notifier]] = []  # a heap, by the numbers of the writes
        self._turns = itertools.count()
        self._is_closed = False
        self.failure: StoreError | None = None
        """The error of the first write that has failed."""
        self.on_failure: Callable[[], None] = lambda: None
        self.on_lost: Callable[[GoalID], None] = lambda _: None
        """The function that is called for a goal that another server has taken over."""
        self.on_refused: Callable[[GoalRecord], None] = lambda _: None
        """The function that is called for a goal of which a write is refused for that reason."""
        self.on_change: Callable[[], None] = lambda: None
        """The function that is called after each write, and after its answer."""

    @asynccontextmanager
    async def open(self, claim: Callable[[StoredGoal], None]) -> AsyncGenerator[None, None]:
        """Open the store for as long as the block lasts; `claim` is called for each stored goal.

        Raises:
            StoreError: The store cannot be used.
        """
        async with self._store.open(
            self._action,
            max_results=self._max_results,
            claim=claim,
            lose=lambda goal_id: self.on_lost(goal_id),
        ) as self._journal:
            yield

    def set_room(self, running: float, waiting: float) -> None:
        """Tell the store how many more goals the server can run and queue."""
        self._journal.set_room(running, waiting)

    @property
    def has_lease(self) -> bool:  # type: ignore[override]  # it can only be read
        """True if the goals belong to this server only until a time, `valid_until`."""
        return type(self._journal).valid_until is not GoalJournal.valid_until

    @property
    def is_valid(self) -> bool:  # type: ignore[override]  # as above
        """True if the goals belong to this server for certain."""
        return current_time() < self._journal.valid_until

    # Writes

    def accept(
        self,
        goal: GoalRecord,
        payload: bytes,
        meta: dict[str, str] | None,
        *,
        is_running: bool,
        then: Kept,
        too_large: TooLarge,
    ) -> int:
        """Keep a goal that is about to be accepted, and return the number of the write."""
        deadline = 0
        if goal.deadline - current_time() < LONGEST:
            deadline = time.time_ns() + int((goal.deadline - current_time()) * SECOND)
        goal.stored = StoredGoal(
            goal.goal_id,
            goal.stamp,
            goal.sender,
            goal.digest,
            payload,
            deadline,
            is_running=is_running,
            attempt=int(is_running),
            meta=meta,
        )
        kept = partial(then, goal, Event.ACCEPTANCE_KEPT)
        return self._write(self._journal.accept, goal, goal.stored, kept, partial(too_large, goal))

    def begin(self, goal: GoalRecord, event: Event, then: Kept) -> bool:
        """Keep that an attempt at the goal begins, unless its acceptance has said so."""
        stored = _stored(goal)
        if stored.is_running:
            return True
        stored.is_running, stored.attempt = True, goal.attempt
        self._write(self._journal.begin, goal, stored, partial(then, goal, event))
        return False

    def cancel(self, goal: GoalRecord, then: Kept) -> bool:
        """Keep that a cancel of the goal was accepted."""
        stored = _stored(goal)
        stored.status = GoalStatus.CANCELING
        self._write(self._journal.cancel, goal, stored, partial(then, goal, Event.CANCEL_KEPT))
        return False

    def checkpoint(self, goal: GoalRecord, state: bytes) -> int:
        """Keep a checkpoint, and return the number of the write."""
        stored = _stored(goal)
        earlier, stored.checkpoint = stored.checkpoint, state
        number = self._written + 1

        def too_large(error: RecordTooLarge) -> None:
            self._too_large[number] = error
            if stored.checkpoint is state:
                stored.checkpoint = earlier

        return self._write(self._journal.checkpoint, goal, stored, None, too_large)

    async def keep_state(self, goal: GoalRecord, encode: Callable[[], bytes]) -> None:
        """See `Keeper.keep_state`."""
        if not goal.phase.is_open or goal.stored is None:
            raise RuntimeError(f"goal {goal.goal_id} has ended, and keeps no checkpoint")
        await self.kept(self.checkpoint(goal, encode()))
        if goal.phase is Phase.LOST:
            raise GoalTaken(GOAL_IS_TAKEN)

    def end(
        self, goal: GoalRecord, outcome: Outcome[bytes], then: Kept, too_large: TooLarge
    ) -> bool:
        """Keep the end of the goal."""
        stored, goal.stored = _stored(goal), None
        now = time.time_ns()
        stored.status, stored.result, stored.reason = (
            outcome.status,
            outcome.result,
            outcome.reason,
        )
        stored.is_running, stored.goal, stored.checkpoint, stored.meta = False, b"", None, None
        stored.feedback_count, stored.ended_at = goal.feedback_count, now
        if self._keep_for < LONGEST:
            stored.keep_until = now + int((self._keep_for + OUTCOME_GRACE) * SECOND)

        def keep_without(error: RecordTooLarge) -> None:
            goal.stored = stored
            too_large(goal, error)

        kept = partial(then, goal, Event.END_KEPT)
        self._write(self._journal.end, goal, stored, kept, keep_without)
        return False

    def release(self, goal: GoalRecord, then: Kept) -> None:
        """Keep that the goal is free, to be run again."""
        stored = _stored(goal)
        stored.is_running = False
        self._write(self._journal.release, goal, stored, partial(then, goal, Event.RELEASE_KEPT))

    def _write(
        self,
        method: Callable[[StoredGoal, Then], None],
        goal: GoalRecord,
        stored: StoredGoal,
        then: Callable[[], None] | None,
        too_large: Callable[[RecordTooLarge], None] | None = None,
    ) -> int:
        self._written += 1
        if self.failure is None and not self._is_closed:
            method(stored, partial(self._note, goal, then, too_large))
            self.on_change()
        return self._written

    # Answers

    def _note(
        self,
        goal: GoalRecord,
        then: Callable[[], None] | None,
        too_large: Callable[[RecordTooLarge], None] | None,
        error: StoreError | None,
    ) -> None:
        if isinstance(error, GoalTaken) and not (goal.phase is Phase.LOST or self._is_closed):
            self.on_refused(goal)  # at once, as the store may hand it over again
        self._answers.append(_Answer(goal, then, too_large, error))
        if len(self._answers) == 1:
            self._news.notify()

    async def run(self) -> None:
        """Carry out the answers of the store, until canceled."""
        while True:
            while not self._answers:
                await self._news.wait()
            slices = Slices()
            while self._answers:
                self._carry_out(self._answers[0])
                self._answers.popleft()
                await slices.pause()

    def _carry_out(self, answer: _Answer) -> None:
        if self.failure is not None or self._is_closed:
            return
        self._answered += 1
        error = answer.error
        if error is not None and not isinstance(error, GoalTaken | RecordTooLarge):
            self._fail(error)
        elif answer.goal.phase is not Phase.LOST:
            if isinstance(error, RecordTooLarge):
                assert answer.too_large is not None  # only what can grow is too large
                answer.too_large(error)
            elif answer.then is not None:
                answer.then()
        self.on_change()
        while self._waits and self._waits[0][0] <= self._answered:
            heappop(self._waits)[-1].notify()

    def _fail(self, error: StoreError) -> None:
        logger.error("action server %r stops: %s", self._action, error)
        self.failure = error
        self._end_waits()
        self.on_failure()

    def close(self) -> None:
        """Carry out no more answers: the server has stopped, and did not wait for them any longer.

        What they are about is kept, and is told after the next start.
        """
        self._is_closed = True
        self._end_waits()

    def _end_waits(self) -> None:
        for *_, news in self._waits:
            news.notify()
        self._waits.clear()

    # Waits

    def check(self) -> None:
        """Check that the store has not failed, and that the server has not stopped.

        Raises:
            GoalKept: One of these has happened.
        """
        if self.failure is not None or self._is_closed:
            raise self.stopped()

    def stopped(self) -> GoalKept:
        """Return the error for calls that wait for a server which has stopped."""
        return GoalKept(STORE_IS_LATE if self.failure is None else STORE_FAILED)

    async def kept(self, write: int) -> None:
        """Wait until the write of that number is durable.

        Raises:
            StoreError: It has failed, or one before it.
        """
        await self._wait(write)
        too_large = self._too_large.pop(write, None)
        if too_large is not None:
            raise too_large
        if self.failure is not None:
            raise copy_of(self.failure)
        if self._answered < write:
            raise StoreError(STORE_IS_LATE)

    async def settled(self) -> None:
        """Wait until all writes so far are durable, or one has failed."""
        await self._wait(self._written)

    async def _wait(self, write: int) -> None:
        if self._answered < write and self.failure is None and not self._is_closed:
            news = Notifier()
            heappush(self._waits, (write, next(self._turns), news))
            await news.wait()


def _stored(goal: GoalRecord) -> StoredGoal:
    assert goal.stored is not None
    return goal.stored

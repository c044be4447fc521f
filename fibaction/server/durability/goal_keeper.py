"""`GoalKeeper`: the server's side of its store, through which it writes about its goals, in order.

Theory of operation
-------------------

The keeper makes the `StoredGoal` of a goal when it is accepted, brings it up to date at each step,
and hands it to the journal of the store: these are the effects `WRITE_...` of the goal's life. When
a write is kept, the goal takes the step that follows (`KEPT`), and clients are told. Each write has
a number. The store answers the writes in
their order, from any code on the event loop; one task, `run`, then calls the functions that were
given with the writes, so that they run as in any other task, and in slices. `kept` and `settled`
wait for writes.

The first write that fails is the end: nothing was told about it, nothing is written any more, and
the server stops (`KeeperEvents.fail`). What is too large for the store concerns its goal alone: a
function that was given with the write rejects or ends the goal.

A goal that belongs to another server by now is lost for this one alone: a write of it is refused
(`KeeperEvents.refuse`), or the store says so by itself (`lose`). Both happen at once, and overtake
the answers that wait: those about a lost goal change nothing any more. The same goal may come back
as another record, so a refusal is about a record, and not about an ID.

The store keeps the outcome of most goals that have ended. A goal that was given up is kept whole,
with its last checkpoint, so that a person can look at it and run it again.

Without a store, a server has just a `Keeper`.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from functools import partial
from heapq import heappop, heappush
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from anyio import CancelScope, current_time, move_on_after
from anyio.abc import TaskGroup
from msgspec.structs import replace

from fibaction._runtime.log import clean_logger
from fibaction._runtime.notify import Notifier
from fibaction.border.event_loop import Slices
from fibaction.border.goal_store import (
    GoalJournal,
    GoalStore,
    GoalTaken,
    KeySlots,
    RecordTooLarge,
    StoredGoal,
    Then,
)
from fibaction.server.durability.keeper import (
    GOAL_IS_TAKEN,
    STORE_FAILED,
    STORE_IS_LATE,
    Keeper,
    KeeperEvents,
)
from fibaction.server.execution.suspects import suspects_here
from fibaction.server.life import LIFE, Effect, Event, Phase
from fibaction.words.errors import GoalKept, StoreError, copy_of
from fibaction.words.goals import Outcome
from fibaction.words.statuses import GoalStatus

if TYPE_CHECKING:
    from fibaction.server.execution.executor import AnyRun
    from fibaction.server.registry.goal_record import AnyOffer, GoalRecord
    from fibaction.types.action import Codec

OUTCOME_GRACE = 60.0
"""Seconds for which a store keeps an outcome beyond the result timeout: the client may have waited
for it while the server was away."""
SECOND = 1_000_000_000
LONGEST = 1e9
"""Seconds above which a time is kept as unlimited: about 30 years."""

Kept: TypeAlias = Callable[[], None]
"""A function that is called when a write is durable."""
TooLarge: TypeAlias = Callable[[RecordTooLarge], None]
"""A function that is called when what was to be written is too large for the store."""

logger = clean_logger("fibaction.server")


class _Answered(NamedTuple):
    """The answer of the store to a write."""

    goal: GoalRecord
    then: Kept | None
    too_large: TooLarge | None
    error: StoreError | None


class GoalKeeper(Keeper):
    """The writes of one server to its store."""

    def __init__(
        self,
        store: GoalStore,
        action: str,
        checkpoints: Codec[Any] | None = None,
        *,
        result_timeout: float,
        given_up_timeout: float,
        max_results: int,
    ) -> None:
        """Keep outcomes for so many seconds, goals that were given up for as many others, and so
        many of each at most.
        """
        super().__init__(action, checkpoints, LIFE)
        self._store = store
        self._outcome_time = result_timeout + OUTCOME_GRACE
        self._given_up_time = given_up_timeout
        self._max_results = max_results
        self._journal: GoalJournal
        self._written = 0
        self._answered = 0
        self._answers: deque[_Answered] = deque()
        self._news = Notifier()
        self._too_large: dict[int, RecordTooLarge] = {}  # by the numbers of checkpoints
        self._waits: list[tuple[int, int, Notifier]] = []  # a heap, by the numbers of the writes
        self._turns = itertools.count()
        self._is_closed = False
        self.failure: StoreError | None = None
        """The error of the first write that has failed."""
        self._events: KeeperEvents
        self._scope: CancelScope
        self.life.carry_out(
            {
                Effect.WRITE_ACCEPTANCE: self._write_acceptance,
                Effect.WRITE_BEGIN: partial(self._write_begin, Event.BEGIN_KEPT),
                Effect.WRITE_TAKE_OVER: partial(self._write_begin, Event.TAKE_OVER_KEPT),
                Effect.WRITE_CANCEL: self._write_cancel,
                Effect.WRITE_END: self._write_end,
                Effect.WRITE_RELEASE: self._write_release,
            }
        )

    @asynccontextmanager
    async def open(self, tasks: TaskGroup, events: KeeperEvents) -> AsyncGenerator[None, None]:
        self._events = events
        self.block = self._scope = CancelScope()
        tasks.start_soon(self._run, name=f"store of {self._action}")
        async with self._store.open(
            self._action,
            max_results=self._max_results,
            claim=events.claim,
            lose=events.lose,
            obstacle=events.obstacle,
            ends_unreadable=events.ends_unreadable,
        ) as self._journal:
            self.past = self.intakes = self._journal
            yield

    def start(self, tasks: TaskGroup, *parts: Callable[[TaskGroup], None]) -> None:
        for start in parts:
            start(tasks)

    def look_at_capacity(self) -> None:
        self._events.look_at_capacity()

    def set_capacity(self, running: float, waiting: float) -> None:
        self._journal.set_capacity(running, waiting)

    async def key_slots(self, limit: str, most: int) -> KeySlots:
        return await self._journal.key_slots(limit, most)

    @property
    def has_lease(self) -> bool:  # type: ignore[override]  # it can only be read
        """True if the goals belong to this server only until a time, `valid_until`."""
        return type(self._journal).valid_until is not GoalJournal.valid_until

    @property
    def is_valid(self) -> bool:  # type: ignore[override]  # as above
        """True if the goals belong to this server for certain."""
        return current_time() < self._journal.valid_until

    # Writes

    def _write_acceptance(self, offer: AnyOffer) -> None:
        goal, deadline, is_running = offer.goal, 0, offer.is_running
        if goal.deadline - current_time() < LONGEST:
            deadline = time.time_ns() + int((goal.deadline - current_time()) * SECOND)
        goal.stored = StoredGoal(
            goal.goal_id,
            goal.stamp,
            goal.sender,
            goal.digest,
            offer.sent.goal,
            deadline,
            is_running=is_running,
            attempt=int(is_running),
            meta=offer.meta,
            began_at=goal.stamp if is_running else 0,
        )

        def too_large(error: RecordTooLarge) -> None:
            offer.too_large = error
            self.life.step(offer, Event.TOO_LARGE)

        kept = partial(self.life.step, offer, Event.ACCEPTANCE_KEPT)
        offer.write = self._write(self._journal.accept, goal, goal.stored, kept, too_large)

    def _write_begin(self, kept: Event, run: AnyRun) -> None:
        """Write that an attempt begins, unless the acceptance has said so."""
        goal, stored = run.goal, _stored(run.goal)
        if stored.is_running:
            self.life.step(run, kept)
            return
        stored.is_running, stored.attempt = True, goal.attempt
        stored.began_at = stored.began_at or time.monotonic_ns() + goal.clock
        self._write(self._journal.begin, goal, stored, partial(self.life.step, run, kept))

    def _write_cancel(self, run: AnyRun) -> None:
        stored = _stored(run.goal)
        stored.status = GoalStatus.CANCELING
        kept = partial(self.life.step, run, Event.CANCEL_KEPT)
        self._write(self._journal.cancel, run.goal, stored, kept)

    def checkpoint(self, goal: GoalRecord, state: bytes) -> int:
        """Keep a checkpoint, and return the number of the write."""
        stored = _stored(goal)
        earlier, lost, reason = stored.checkpoint, stored.lost, stored.reason
        if state != earlier:  # the lost attempts have brought the goal further
            stored.checkpoint, stored.lost, stored.reason = state, 0, ""
        number = self._written + 1

        def too_large(error: RecordTooLarge) -> None:
            self._too_large[number] = error
            if stored.checkpoint is state:
                stored.checkpoint, stored.lost, stored.reason = earlier, lost, reason

        return self._write(self._journal.checkpoint, goal, stored, None, too_large)

    async def _keep_state(self, goal: GoalRecord, encode: Callable[[], bytes]) -> None:
        stored = goal.stored
        if not goal.phase.is_open or stored is None:
            raise RuntimeError(f"goal {goal.goal_id} has ended, and keeps no checkpoint")
        await self.kept(self.checkpoint(goal, encode()))
        if goal.phase is Phase.LOST:
            raise GoalTaken(GOAL_IS_TAKEN)
        if goal.suspicion and not stored.lost:
            suspects_here().clear(goal)

    def _write_end(self, run: AnyRun) -> None:
        """Write the outcome; one that is too large is replaced by the reason."""
        goal = run.goal
        outcome = run.outcome
        assert outcome is not None
        stored, goal.stored = _stored(goal), None
        self._note_end(stored, goal, outcome)

        def keep_without(error: RecordTooLarge) -> None:
            goal.stored = stored
            if goal.is_given_up:  # there may be room without the goal itself
                goal.is_given_up = False
                self._write_end(run)
            else:
                reason = f"the result is not kept: {error}"
                status = GoalStatus.ABORTED
                run.outcome = replace(outcome, status=status, result=None, reason=reason)
                self.life.step(run, Event.TOO_LARGE)

        kept = partial(self.life.step, run, Event.END_KEPT)
        self._write(self._journal.end, goal, stored, kept, keep_without)

    def _note_end(self, stored: StoredGoal, goal: GoalRecord, outcome: Outcome[bytes]) -> None:
        """Bring a stored goal up to date with its end."""
        stored.end(outcome)
        # The times that are kept are compared with the time of day, which may have made a step.
        step = time.time_ns() - time.monotonic_ns() - goal.clock
        stored.ended_at += step if abs(step) > SECOND else 0
        stored.feedback_count = goal.feedback_count
        seconds = self._outcome_time
        if goal.is_given_up and outcome.status is GoalStatus.ABORTED and self._given_up_time:
            seconds = max(seconds, self._given_up_time)
        else:
            stored.drop_request()
        if seconds < LONGEST:
            stored.keep_until = stored.ended_at + int(seconds * SECOND)

    def _write_release(self, run: AnyRun) -> None:
        stored = _stored(run.goal)
        stored.is_running = False
        kept = partial(self.life.step, run, Event.RELEASE_KEPT)
        self._write(self._journal.release, run.goal, stored, kept)

    def _write(
        self,
        method: Callable[[StoredGoal, Then], None],
        goal: GoalRecord,
        stored: StoredGoal,
        then: Kept | None,
        too_large: TooLarge | None = None,
    ) -> int:
        self._written += 1
        if self.failure is None and not self._is_closed:
            method(stored, partial(self._note, goal, then, too_large))
            self._events.look_at_capacity()
        return self._written

    # Answers

    def _note(
        self,
        goal: GoalRecord,
        then: Kept | None,
        too_large: TooLarge | None,
        error: StoreError | None,
    ) -> None:
        if isinstance(error, GoalTaken) and not (goal.phase is Phase.LOST or self._is_closed):
            self._events.refuse(goal)  # at once, as the store may hand it over again
        self._answers.append(_Answered(goal, then, too_large, error))
        if len(self._answers) == 1:
            self._news.notify()

    async def _run(self) -> None:
        """Carry out the answers of the store, until canceled."""
        while True:
            while not self._answers:
                await self._news.wait()
            slices = Slices()
            while self._answers:
                self._carry_out(self._answers[0])
                self._answers.popleft()
                await slices.pause()

    def _carry_out(self, answer: _Answered) -> None:
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
        self._events.look_at_capacity()
        while self._waits and self._waits[0][0] <= self._answered:
            heappop(self._waits)[-1].notify()

    def _fail(self, error: StoreError) -> None:
        logger.error("action server %r stops: %s", self._action, error)
        self.failure = error
        self._end_waits()
        self._events.fail()
        self._scope.cancel()

    def close(self) -> None:
        # What the answers are about is kept, and is told after the next start.
        self._is_closed = True
        self._end_waits()

    def _end_waits(self) -> None:
        for *_, news in self._waits:
            news.notify()
        self._waits.clear()

    # Waits

    def check(self) -> None:
        if self.failure is not None:
            raise GoalKept(STORE_FAILED)
        if self._is_closed:
            raise GoalKept(STORE_IS_LATE)

    async def kept(self, write: int) -> None:
        await self._wait(write)
        too_large = self._too_large.pop(write, None)
        if too_large is not None:
            raise too_large
        if self.failure is not None:
            raise copy_of(self.failure)
        if self._answered < write:
            raise StoreError(STORE_IS_LATE)

    async def settled(self) -> None:
        await self._wait(self._written)

    async def settled_within(self, seconds: float) -> None:
        with move_on_after(seconds, shield=True):
            await self.settled()

    async def _wait(self, write: int) -> None:
        if self._answered < write and self.failure is None and not self._is_closed:
            news = Notifier()
            heappush(self._waits, (write, next(self._turns), news))
            await news.wait()


def _stored(goal: GoalRecord) -> StoredGoal:
    assert goal.stored is not None
    return goal.stored

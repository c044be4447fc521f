"""`MemoryStore`: a store for tests, in memory, which can answer late, fail, and die.

A write waits until it is due, then it becomes durable, then it is answered: in order, and by
default in the next turn of the event loop. `fate` decides on each write when it is due.
A journal whose process is dead keeps nothing any more and answers nothing, and the store can be
opened again, as after a restart.

As a real store does, it takes from a goal only what a method is about, so a server that changes
something else and does not write it is found.

Other servers can take goals over, which are then not among `goals`: at a write (`Fate.TAKEN`) or at
any time (`take`). `give` hands a goal over to the server that has the store open.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from enum import Enum
from typing import NamedTuple

from anyio import CancelScope, current_time, sleep_until
from anyio.lowlevel import checkpoint
from msgspec.structs import replace

from fibaction import GoalID, GoalStatus
from fibaction._runtime.notify import Notifier
from fibaction.border.event_loop import Background
from fibaction.border.goal_store import (
    GoalJournal,
    GoalStore,
    GoalTaken,
    StoredGoal,
    Then,
    no_obstacle,
)
from fibaction.words.errors import StoreError

BROKEN = "the store is broken, on purpose"


class Fate(Enum):
    """The fate of a write, and of all after it."""

    KEPT = "kept"
    FAILED = "failed"
    """It fails, and so do all later ones."""
    DOUBTFUL = "doubtful"
    """It is kept, and said to have failed; all later ones fail."""
    TAKEN = "taken"
    """Its goal belongs to another server."""
    LOST = "lost"
    """The process dies before it is kept."""
    UNANSWERED = "unanswered"
    """The process dies after it was kept, before it is answered."""


class _Write(NamedTuple):
    number: int
    takeovers: int
    what: str
    goal: StoredGoal
    then: Then
    due: float


class MemoryStore(GoalStore):
    """A store in memory, which outlives the servers that use it."""

    def __init__(
        self,
        fate: Callable[[int, str], Fate] = lambda _number, _what: Fate.KEPT,
        *,
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self.fate = fate
        """The function that decides on a write, by its number and its method."""
        self.delay: Callable[[], float] = lambda: 0.0
        """The function that returns the seconds from a write to its answer."""
        self.is_holding = False
        """True if writes wait for `release`."""
        self.goals: dict[tuple[str, GoalID], StoredGoal] = {}
        """The goals that are kept."""
        self.writes = 0
        """The number of writes so far."""
        self.on_kept: Callable[[str, StoredGoal], None] = lambda _what, _goal: None
        """The function that is called before a write is answered as durable: with its method, and
        the goal."""
        self.on_claim: Callable[[StoredGoal], None] = lambda _goal: None
        """The function that is called before a goal is given to the next server."""
        self.on_forget: Callable[[StoredGoal], None] = lambda _goal: None
        """The function that is called with an outcome that is too old, or one too many."""
        self.on_death: Callable[[], None] = lambda: None
        """The function that is called when a fate lets the process die."""
        self.clock = clock
        self.on_taken: Callable[[StoredGoal], None] = lambda _goal: None
        """The function that is called with a goal that another server takes over."""
        self.valid_until: Callable[[], float] = lambda: math.inf
        """The function that returns the time until which the goals belong to their server."""
        self.rooms: list[tuple[float, float]] = []
        """The room for goals that servers have told."""
        self.takeovers: Counter[tuple[str, GoalID]] = Counter()
        """The number of times that each goal was taken over by another server."""
        self.elsewhere: set[tuple[str, GoalID]] = set()
        """The goals that other servers have, and that cannot be accepted here."""
        self.journals: dict[str, MemoryJournal] = {}
        """The journals that are open, by their actions."""
        self.obstacles: dict[str, Callable[[StoredGoal], str]] = {}
        """The function of each open server that says why it cannot run a goal, by its action."""
        self._dead: list[MemoryJournal] = []

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
    ) -> AsyncGenerator[MemoryJournal, None]:
        """See `GoalStore.open`."""
        if action in self.journals:
            raise StoreError(f"the store is in use for {action!r}: stop its server first")
        self.obstacles[action] = obstacle
        journal = self.journals[action] = MemoryJournal(self, action, max_results, claim, lose)
        try:
            journal.forget_old()
            kept = [goal for (name, _), goal in self.goals.items() if name == action]
            ended = [goal for goal in kept if goal.status.is_terminal]
            active = [goal for goal in kept if goal.status.is_active]
            ended.sort(key=lambda one: one.ended_at)
            active.sort(key=lambda one: one.stamp)
            for goal in (*ended, *active):
                self.on_claim(goal)
                claim(replace(goal))
            async with Background() as answering:
                answering.start_soon(journal.answer)
                try:
                    yield journal
                finally:
                    with CancelScope(shield=True):
                        await journal.settled()
        finally:
            if self.journals.get(action) is journal:
                del self.journals[action]

    def take(self, action: str, goal_id: GoalID) -> StoredGoal | None:
        """Let another server take a goal over, and return it as it was kept."""
        goal = self.note_takeover(action, goal_id)
        if action in self.journals:
            self.journals[action].lose(goal_id)
        return goal

    def note_takeover(self, action: str, goal_id: GoalID) -> StoredGoal | None:
        """Refuse the writes under way about a goal, which another server has."""
        self.takeovers[action, goal_id] += 1
        goal = self.goals.pop((action, goal_id), None)
        if goal is not None:
            self.elsewhere.add((action, goal_id))
            self.on_taken(goal)
        return goal

    def give(self, action: str, goal: StoredGoal) -> None:
        """Hand a goal over, that another server had, to the one that has the store open."""
        self.elsewhere.discard((action, GoalID(goal.goal_id)))
        self.goals[action, goal.goal_id] = goal
        self.on_claim(goal)
        if action in self.journals:
            self.journals[action].claim(replace(goal))

    def die(self, applied: int = 0) -> None:
        """Let the process die: all writes under way are lost, but for the first `applied` ones."""
        for journal in self.journals.values():
            journal.die(applied)
            self._dead.append(journal)
        self.journals.clear()

    def bury(self) -> None:
        """Fail what dead processes still wait for, so that their tasks can end."""
        for journal in self._dead:
            journal.bury()
        self._dead.clear()

    def hold(self) -> None:
        """Let all writes from now on wait."""
        self.is_holding = True

    def release(self) -> None:
        """Let the writes that wait go on."""
        self.is_holding = False
        for journal in self.journals.values():
            journal.news.notify()


class MemoryJournal(GoalJournal):
    """The goals of one action in a store in memory."""

    def __init__(
        self,
        store: MemoryStore,
        action: str,
        max_results: int,
        claim: Callable[[StoredGoal], None],
        lose: Callable[[GoalID], None],
    ) -> None:
        self.claim, self.lose = claim, lose
        self._store = store
        self._action = action
        self._max_results = max_results
        self._writes: deque[_Write] = deque()
        self._due = -math.inf
        self._failure: StoreError | None = None
        self.is_dead = False
        """True if its process is dead."""
        self.news = Notifier()
        self._empty = Notifier()

    # The port

    @property
    def valid_until(self) -> float:
        """See `GoalJournal.valid_until`."""
        return self._store.valid_until()

    def set_capacity(self, running: float, waiting: float) -> None:
        """See `GoalJournal.set_capacity`."""
        self._store.rooms.append((running, waiting))

    def accept(self, goal: StoredGoal, then: Then) -> None:
        """See `GoalJournal.accept`."""
        self._write("accept", goal, then)

    def begin(self, goal: StoredGoal, then: Then) -> None:
        """See `GoalJournal.begin`."""
        self._write("begin", goal, then)

    def cancel(self, goal: StoredGoal, then: Then) -> None:
        """See `GoalJournal.cancel`."""
        self._write("cancel", goal, then)

    def checkpoint(self, goal: StoredGoal, then: Then) -> None:
        """See `GoalJournal.checkpoint`."""
        self._write("checkpoint", goal, then)

    def end(self, goal: StoredGoal, then: Then) -> None:
        """See `GoalJournal.end`."""
        self._write("end", goal, then)

    def release(self, goal: StoredGoal, then: Then) -> None:
        """See `GoalJournal.release`."""
        self._write("release", goal, then)

    def _write(self, what: str, goal: StoredGoal, then: Then) -> None:
        if self.is_dead:
            return
        self._store.writes += 1
        delay = self._store.delay()
        self._due = max(self._due, current_time() + delay if delay else -math.inf)
        takeovers = self._store.takeovers[self._action, goal.goal_id]
        self._writes.append(
            _Write(self._store.writes, takeovers, what, replace(goal), then, self._due)
        )
        self.news.notify()

    # Answers

    async def answer(self) -> None:
        """Make writes durable, and answer them."""
        try:
            await self._answer()
        finally:
            self.die()

    async def _answer(self) -> None:
        while True:
            while not self._writes or self._store.is_holding:
                await self.news.wait()
            if self._writes[0].due > -math.inf:
                await sleep_until(self._writes[0].due)
            for _ in range(len(self._writes)):
                if self._writes[0].due > current_time() or self._store.is_holding:
                    break
                error = self._carry_out(self._writes[0])
                if self.is_dead:
                    return
                self._writes.popleft().then(error)
            if not self._writes:
                self._empty.notify()
            await checkpoint()  # what was written by the answers is answered in the next turn

    def _carry_out(self, write: _Write) -> StoreError | None:
        fate = self._store.fate(write.number, write.what)
        if self._failure is None and fate in (Fate.FAILED, Fate.DOUBTFUL):
            self._failure = StoreError(BROKEN)
            if fate is Fate.DOUBTFUL:
                self._keep(write)
        if self._failure is not None:
            return self._failure
        goal_id = GoalID(write.goal.goal_id)
        if (self._action, goal_id) in self._store.elsewhere:
            return GoalTaken(BROKEN)
        if write.takeovers < self._store.takeovers[self._action, goal_id]:
            return GoalTaken(BROKEN)
        if fate is Fate.TAKEN:
            self._store.note_takeover(self._action, goal_id)
            return GoalTaken(BROKEN)
        if fate is not Fate.LOST:
            self._keep(write)
        if fate is Fate.KEPT:
            goal = self._store.goals.get((self._action, write.goal.goal_id), write.goal)
            self._store.on_kept(write.what, goal)
        else:
            self._store.die()
            self._store.on_death()
        return None

    async def settled(self) -> None:
        """Wait until all writes are answered."""
        while self._writes and not self.is_dead:
            await self._empty.wait()

    def die(self, applied: int = 0) -> None:
        """Lose all writes under way, but for the first `applied` ones, and answer none of them."""
        for write in tuple(self._writes)[:applied]:
            self._keep(write)
        self.is_dead = True
        self._empty.notify()

    def bury(self) -> None:
        """Fail what its dead process still waits for."""
        while self._writes:
            self._writes.popleft().then(StoreError(BROKEN))

    # What is kept

    def _keep(self, write: _Write) -> None:
        goals, goal, what = self._store.goals, write.goal, write.what
        key = (self._action, goal.goal_id)
        known = goals.get(key)
        if what == "accept":
            assert known is None or known.status.is_terminal, f"accepted twice: {goal}"
            goals.pop(key, None)
            goals[key] = goal
        else:
            assert known is not None, f"{what} of a goal that was not accepted: {goal}"
            assert known.status.is_active, f"{what} of a goal that has ended: {goal}"
            goals[key] = known = _changed(known, what, goal)
        if what == "end":
            self.forget_old()

    def forget_old(self) -> None:
        """Forget the outcomes that are too old or too many."""
        goals = self._store.goals
        mine = [goal for (action, _), goal in goals.items() if action == self._action]
        ended = sorted(
            (goal for goal in mine if goal.status.is_terminal), key=lambda one: one.ended_at
        )
        now = self._store.clock()
        newest = {
            goal.goal_id
            for given_up in (True, False)
            for goal in [one for one in ended if one.is_given_up is given_up][::-1][
                : self._max_results
            ]
        }
        for goal in ended:
            if goal.goal_id not in newest or 0 < goal.keep_until <= now:
                del goals[self._action, goal.goal_id]
                self._store.on_forget(goal)


def _changed(known: StoredGoal, what: str, goal: StoredGoal) -> StoredGoal:
    """Return a goal as it is kept after a write that says what has changed."""
    if what == "begin":
        return replace(
            known,
            is_running=goal.is_running,
            attempt=goal.attempt,
            lost=goal.lost,
            began_at=goal.began_at,
        )
    if what == "cancel":
        assert goal.status is GoalStatus.CANCELING, goal
        return replace(known, status=goal.status)
    if what == "checkpoint":
        return replace(known, checkpoint=goal.checkpoint, lost=goal.lost)
    if what == "release":
        return replace(known, is_running=False)
    assert goal.status.is_terminal, goal
    return replace(
        known,
        goal=goal.goal,
        checkpoint=goal.checkpoint,
        meta=goal.meta,
        is_running=False,
        status=goal.status,
        result=goal.result,
        reason=goal.reason,
        feedback_count=goal.feedback_count,
        ended_at=goal.ended_at,
        keep_until=goal.keep_until,
    )

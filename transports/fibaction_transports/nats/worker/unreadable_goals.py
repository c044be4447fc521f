"""The goals that a worker cannot run, and that it leaves to others.

Theory of operation
-------------------

The workers of a fleet may be of different versions, and each of them takes all notes of its
actions. The first time that a worker takes the note of a goal that it cannot run, it adds the note
again at once, so that another worker finds it. A note that comes back was not wanted by others, or
no other was there: it is held before it is added again, each time for longer. So notes that no
living worker wants cost little, and those that come after them are not delayed (`NotesForOthers`).

The queue gives a note to the reader that has asked first. So a note is held for a second only, and
longer if there are very many, or this worker would mostly have asked before one that comes later.
It is held for less time than the queue gives a reader. If this worker is lost meanwhile, the
note comes again by itself. Scans may add a note of a goal that has one already: the second one is
removed while the first is held.

A goal that has no worker, and that none can run, waits. Each worker counts those that it cannot run
itself (`UnreadableGoals`), by their notes and by its scans, and tells the number in its lease and
in its log. In each lease it looks whether some of them have found a worker, and those that were
found less than a lease ago are not told: a worker that can run them may be taking them.

A server may end such goals (`unreadable="abort"`). They are to wait for ten leases before, as a
worker that can run them may be starting again. Then each living worker of the action is asked
whether it can run the goal. If one says so, or does not answer, the goal is left to it. Else this
worker takes it, and its server ends it.
"""

from __future__ import annotations

from itertools import islice

from anyio import current_time, sleep
from anyio.abc import TaskGroup
from msgspec import Struct

from fibaction.border.abc import Notifier
from fibaction.border.goal_store import StoredGoal
from fibaction.border.peer_text import clean_logger
from fibaction.words.goals import GoalID
from fibaction_transports.nats.broker.broker import (
    Broker,
    BrokerAway,
    BrokerSubscription,
    Message,
    NoResponders,
    Note,
    OnMessage,
)
from fibaction_transports.nats.worker.journal import FleetJournal, WorkerJournals
from fibaction_transports.nats.worker.lease import FIRST_PAUSE, LONGEST_PAUSE
from fibaction_transports.nats.worker.lost_workers import LostWorkers, active_record
from fibaction_transports.nats.workers import FleetWorkers

HOLD, LONGEST_HOLD = 1.0, 4.0
"""Seconds for which a note is held; one that is not done comes again after five."""
NOTES_PER_SECOND = 100.0
"""The number of notes in a second above which they are held for longer."""
MOST_KNOWN = 100_000
"""The number of goals that are remembered."""
LOOKED_AT_IN_A_LEASE = 64
"""The number of goals that are looked at in each lease."""
LEASES_UNTIL_END = 10
"""The number of leases for which a goal waits before it is ended."""
CAN_RUN, CANNOT_RUN = b"yes", b"no"
"""The answers to the question whether a worker can run a goal."""
ANSWER_TIME = 2.0
"""Seconds that a worker has to answer whether it can run a goal."""

logger = clean_logger("fibaction.nats")


class NotesForOthers:
    """The notes that one worker gives back, of one action."""

    def __init__(
        self, broker: Broker, journal: FleetJournal, unreadable: UnreadableGoals, tasks: TaskGroup
    ) -> None:
        """Hold notes in tasks of this group."""
        self._broker = broker
        self._journal = journal
        self._unreadable = unreadable
        self._tasks = tasks
        self._pauses: dict[GoalID, float] = {}  # before the next return of a note
        self._held: set[tuple[str, GoalID]] = set()

    def give_back(self, subject: str, note: Note, goal: StoredGoal, *, is_left: bool) -> bool:
        """Give the note of a goal back to its subject if the server cannot run the goal; return
        whether that is so. `is_left` says that the goal has no worker.
        """
        obstacle = self._unreadable.look_at(goal) if is_left else self._journal.obstacle(goal)
        if not obstacle:
            return False
        goal_id = goal.goal_id
        pause = self._pauses.get(goal_id)
        if pause is None:
            if len(self._pauses) >= MOST_KNOWN:
                del self._pauses[next(iter(self._pauses))]
            self._pauses[goal_id] = FIRST_PAUSE
            self._broker.add_note(subject, note.data)
            note.done()
        elif (subject, goal_id) in self._held:
            note.done()
        else:
            longest = min(max(HOLD, len(self._held) / NOTES_PER_SECOND), LONGEST_HOLD)
            self._pauses[goal_id] = min(2 * pause, longest)
            self._held.add((subject, goal_id))
            self._tasks.start_soon(self._hold, subject, note, goal_id, pause)
        return True

    async def _hold(self, subject: str, note: Note, goal_id: GoalID, pause: float) -> None:
        await sleep(pause)
        self._held.discard((subject, goal_id))
        self._broker.add_note(subject, note.data)
        note.done()


class _Unread(Struct, frozen=True):
    """A goal that has no worker, and that this one cannot run."""

    since: float
    obstacle: str


class UnreadableGoals:
    """The goals of one action that have no worker, and that this one cannot run."""

    def __init__(
        self,
        journals: WorkerJournals,
        journal: FleetJournal,
        lost: LostWorkers,
        workers: FleetWorkers,
        *,
        ends: bool,
    ) -> None:
        """Take those that no worker can run if the server `ends` them."""
        self._broker = journals.broker
        self._names = journals.names
        self._membership = journals.membership
        self._counts = journals.unreadable
        self._journal = journal
        self._lost = lost
        self._workers = workers
        self._ends = ends
        self._known: dict[GoalID, _Unread] = {}
        self._news = Notifier()

    def look_at(self, goal: StoredGoal) -> str:
        """Return why the server cannot run a goal that has no worker; empty if it can."""
        obstacle = self._journal.obstacle(goal)
        is_new = goal.goal_id not in self._known and len(self._known) < MOST_KNOWN
        if obstacle and is_new:
            self._known[GoalID(goal.goal_id)] = _Unread(current_time(), obstacle)
            self._news.notify()
        return obstacle

    async def run(self, tasks: TaskGroup) -> None:
        """Count the goals, tell their number, and answer the questions of other workers, in tasks
        of this group, until canceled.
        """

        def on_question(message: Message) -> None:
            tasks.start_soon(self._answer, message)

        subscription = await self._listen(on_question)
        try:
            while True:
                if not self._known:
                    await self._news.wait()
                await sleep(self._membership.lease)
                await self._count()
        finally:
            subscription.close()

    async def _count(self) -> None:
        """Forget the goals that have a worker by now, and tell the number of the others."""
        try:
            while await self._has_shrunk():
                pass
        except BrokerAway as exc:
            logger.debug("the goals that cannot run here are not counted: %s", exc)
        else:
            self._tell()

    async def _has_shrunk(self) -> bool:
        """Look at the goals that were not looked at for the longest time; return whether some of
        them are not left any more.
        """
        before = len(self._known)
        for goal_id in tuple(islice(self._known, LOOKED_AT_IN_A_LEASE)):
            is_left = await self._is_left(goal_id, self._known[goal_id].since)
            unread = self._known.pop(goal_id)
            if is_left:
                self._known[goal_id] = unread
        return len(self._known) < before

    async def _is_left(self, goal_id: GoalID, since: float) -> bool:
        """Return whether a goal has no worker, and this one cannot run it; end it if it is time."""
        found = await active_record(self._broker, self._names, self._journal.action, goal_id)
        if found is None or not await self._lost.is_gone(found[1]):
            return False
        record, entry = found
        if not self._journal.obstacle(entry.goal):
            return False
        is_due = self._ends and current_time() >= since + LEASES_UNTIL_END * self._membership.lease
        if is_due and not await self._can_run_elsewhere(goal_id):
            return not await self._journal.take(record, entry.goal)
        return True

    def _tell(self) -> None:
        """Tell the number of the goals that were found a lease ago: others may take newer ones."""
        latest = current_time() - self._membership.lease
        left = [goal_id for goal_id, unread in self._known.items() if unread.since <= latest]
        action, count = self._journal.action, len(left)
        before = self._counts.get(action, 0)
        if count == before:
            return
        self._counts[action] = count
        self._membership.note_change()
        if count > before:
            goals = "1 goal" if count == 1 else f"{count:,} goals"
            or_else = "or they are ended" if self._ends else "or end them with unreadable='abort'"
            logger.warning(
                "%s of %r without a worker cannot run at this one, for example %s: %s; start a"
                " worker of the version that accepted them, %s",
                goals,
                action,
                left[0],
                self._known[left[0]].obstacle,
                or_else,
            )
        elif not count:
            logger.warning("all goals of %r have a worker again, or have ended", action)

    # Questions

    async def _listen(self, on_question: OnMessage) -> BrokerSubscription:
        subject = self._names.reads(self._membership.worker, self._journal.action)
        while True:
            try:
                return await self._broker.subscribe(subject, on_question)
            except BrokerAway:
                await sleep(LONGEST_PAUSE)

    async def _answer(self, message: Message) -> None:
        """Answer the question of another worker whether this one can run a goal."""
        try:
            goal_id = GoalID(message.data)
            found = await active_record(self._broker, self._names, self._journal.action, goal_id)
        except (ValueError, BrokerAway):
            return
        can_run = found is not None and not self._journal.obstacle(found[1].goal)
        self._broker.publish(message.reply, CAN_RUN if can_run else CANNOT_RUN)

    async def _can_run_elsewhere(self, goal_id: GoalID) -> bool:
        """Return whether another living worker can run a goal, or does not say."""
        action, me = self._journal.action, self._membership.worker
        for lease in self._workers.serving(action, is_kept=True):
            if lease.worker == me:
                continue
            subject = self._names.reads(lease.worker, action)
            try:
                answer = await self._broker.request(subject, bytes(goal_id), ANSWER_TIME)
            except (BrokerAway, NoResponders):
                return True
            if answer != CANNOT_RUN:
                return True
        return False

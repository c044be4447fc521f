"""`Takeover`: the goals that come to a worker from others: lost, released, or waiting there.

Theory of operation
-------------------

A worker whose lease has ended, by default 5 s after it was renewed last, or 15 s where three
brokers or more keep the records, is cleared up after by one of the others: whoever puts a
`LeaseEntry` without an incarnation over the marker. It reads the records of all goals, and adds a
note to `left` for each active one whose owner is gone. That claim ends like a lease, and then
another one clears up: the first one may be lost, too. Whoever has read all records says that it is
done, over the newest claim.

Each worker also scans now and then for the actions that it serves, and when it has joined: a worker
may have been lost while nobody watched, or have had a write under way when it was cleared up after.

A note says only that there may be something to do; the record says what. Each worker takes the
notes of `left` for its actions, whether it has room or not, and those of `want` while it can run
goals. It takes a goal by a write over the record that it has read, so one wins, and then the server
claims it. The owner of a goal that waited gets a hint to the subject `taken`, and reads the record.
A goal that its server cannot run is left to workers of another version (`NotesForOthers`).

"Gone" is judged by the brokers alone: see `LostWorkers`.
"""

from __future__ import annotations

from contextlib import aclosing

from anyio import CapacityLimiter, move_on_after, sleep
from anyio.abc import TaskGroup

from fibaction.border.abc import Notifier
from fibaction.border.event_loop import Slices
from fibaction.border.goal_store import StoredGoal
from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import ConnectionLost
from fibaction.words.goals import GoalID
from fibaction_transports.nats.broker.broker import (
    BrokerAway,
    BrokerRecord,
    Message,
    Note,
    PutError,
    PutFailure,
)
from fibaction_transports.nats.names import action_of, last_token
from fibaction_transports.nats.records import (
    GoalEntry,
    LeaseEntry,
    encode,
    is_claim,
)
from fibaction_transports.nats.worker.journal import FleetJournal, WorkerJournals
from fibaction_transports.nats.worker.lease import LEFT_TTL, LONGEST_PAUSE, MemberPart
from fibaction_transports.nats.worker.lost_workers import LostWorkers, active_record, entry_of
from fibaction_transports.nats.worker.record_writes import KeptOutcome
from fibaction_transports.nats.worker.unreadable_goals import NotesForOthers, UnreadableGoals
from fibaction_transports.nats.workers import FleetWorkers

TAKEN_AT_ONCE = 16
"""The number of lost goals of an action that a worker takes over at the same time."""
BEGIN_TIMEOUT = 1.0
"""Seconds after which a goal that was taken and has not begun is offered to others."""
SCAN_INTERVAL = 10
"""The number of leases between two scans for goals without a worker."""

logger = clean_logger("fibaction.nats")


class Takeover(MemberPart):
    """The goals that come to one worker from others."""

    def __init__(self, journals: WorkerJournals, workers: FleetWorkers, lost: LostWorkers) -> None:
        self._broker = journals.broker
        self._names = journals.names
        self._membership = journals.membership
        self._journals = journals
        self._workers = workers
        self._lost = lost
        self._noted: set[int] = set()  # the sequences of records that a scan has found
        self._unreadable: dict[str, UnreadableGoals] = {}  # of the journals, by their actions
        self._rescan = Notifier()  # notifies of a reason to scan the records
        self._membership.add(self)
        workers.when_gone(self._on_gone)

    async def open(self) -> None:
        """Listen to hints, and watch the other workers.

        Raises:
            BrokerAway, ConnectionLost: The brokers do not answer.
        """
        await self._broker.subscribe(self._names.taken(self._membership.worker), self._on_hint)
        await self._workers.ready()

    def start(self, journal: FleetJournal, tasks: TaskGroup, *, ends_unreadable: bool) -> None:
        """Take goals over for a journal, in tasks of this group, until canceled. With
        `ends_unreadable`, its server ends the goals that no worker can run.
        """
        unreadable = self._unreadable[journal.action] = UnreadableGoals(
            self._journals, journal, self._lost, self._workers, ends=ends_unreadable
        )
        tasks.start_soon(unreadable.run, tasks)
        others = NotesForOthers(self._broker, journal, unreadable, tasks)
        tasks.start_soon(self._take_left, journal, others, tasks)
        tasks.start_soon(self._take_wanted, journal, others)
        tasks.start_soon(self._scan_often, journal)

    def note_again(self) -> None:
        """Add notes for all goals without a worker again: those that there were are lost."""
        self._noted.clear()
        self._rescan.notify()

    def joined(self) -> None:
        """See `MemberPart.joined`."""
        self._rescan.notify()

    # Lost workers

    def _on_gone(self, lease: LeaseEntry) -> None:
        self._rescan.notify()
        self._journals.tasks.start_soon(self._clear_up, lease.worker)

    async def _clear_up(self, worker: str) -> None:
        """Clear up after a lost worker, unless another one does."""
        subject = self._names.worker(worker)
        while True:
            try:
                record = await self._lost.record_of(worker)
                if record is not None and record.data:
                    return  # it has joined again, has left cleanly, or is cleared up after
                me = self._membership
                entry = LeaseEntry(worker, b"", lease=me.lease, cleared_by=me.worker)
                stored = await self._put(subject, entry, record.sequence if record else 0)
                if isinstance(stored, int):
                    logger.warning("worker %r is gone; its goals are taken over", worker)
                    await self._scan(self._names.all_goals(), again=True)
                    await self._finish(worker, subject)
                    return
                if stored.kind is PutFailure.REFUSED:
                    return
            except BrokerAway:
                pass
            await sleep(LONGEST_PAUSE)

    async def _finish(self, worker: str, subject: str) -> None:
        """Say that a lost worker is cleared up after, so that the end of a claim has no effect."""
        record = await self._broker.get(self._names.workers, subject)
        if record is None or not record.data or is_claim(record.data):
            expected = record.sequence if record else 0
            await self._put(subject, LeaseEntry(worker, b""), expected)

    async def _put(self, subject: str, entry: LeaseEntry, expected: int) -> int | PutError:
        ttl = entry.lease or LEFT_TTL
        return await self._broker.put_and_wait(subject, encode(entry), expected=expected, ttl=ttl)

    # Scans

    async def _scan_often(self, journal: FleetJournal) -> None:
        while True:
            try:
                await self._workers.ready()
                given_up = await self._scan(self._names.goal(journal.action), again=False)
                journal.outcomes.found(given_up)
            except (BrokerAway, ConnectionLost) as exc:
                logger.debug("the records of goals cannot be read: %s", exc)
                await sleep(LONGEST_PAUSE)
                continue
            with move_on_after(SCAN_INTERVAL * self._membership.lease):
                await self._rescan.wait()

    async def _scan(self, subject: str, *, again: bool) -> list[KeptOutcome]:
        """Add a note for each goal whose worker is gone; `again` also if that was done before.
        Return the goals that were given up.
        """
        given_up: list[KeptOutcome] = []
        async with self._broker.watch(self._names.goals, subject) as watch:
            slices = Slices()
            while (records := await watch.next()) is not None:
                for record in records:
                    entry = entry_of(record)
                    if entry is None:
                        continue
                    goal = entry.goal
                    if goal.is_given_up:
                        given_up.append(KeptOutcome.of(goal, record.subject, record.sequence))
                    await self._journals.history.add_left(record, entry, self._lost.is_gone)
                    is_due = goal.status.is_active and (again or record.sequence not in self._noted)
                    if is_due and await self._lost.is_gone(entry):
                        self._add_note(record, goal)
                    await slices.pause()
        return given_up

    def _add_note(self, record: BrokerRecord, goal: StoredGoal) -> None:
        """Add the note of a goal whose worker is gone."""
        self._noted.add(record.sequence)
        action = action_of(record.subject)
        self._broker.add_note(self._names.left(action), bytes(goal.goal_id))
        if action in self._journals.by_action:
            self._unreadable[action].look_at(goal)

    # Notes

    async def _take_left(
        self, journal: FleetJournal, others: NotesForOthers, tasks: TaskGroup
    ) -> None:
        limit = CapacityLimiter(TAKEN_AT_ONCE)
        async with aclosing(self._broker.notes(self._names.left(journal.action))) as notes:
            async for note in notes:  # pragma: no branch  # they continue until a cancel
                await limit.acquire_on_behalf_of(note)
                tasks.start_soon(self._take_one_left, journal, others, note, limit)

    async def _take_one_left(
        self, journal: FleetJournal, others: NotesForOthers, note: Note, limit: CapacityLimiter
    ) -> None:
        try:
            goal_id = await self._taken(journal, others, note, is_left=True)
        finally:
            limit.release_on_behalf_of(note)
        await self._wait_for_begin(journal, goal_id)

    async def _take_wanted(self, journal: FleetJournal, others: NotesForOthers) -> None:
        subject = self._names.want(journal.action)
        async with aclosing(self._broker.notes(subject)) as notes:
            while True:
                while not self._has_room(journal):
                    await self._journals.room.wait()
                note = await anext(notes)
                if self._has_room(journal):
                    goal_id = await self._taken(journal, others, note, is_left=False)
                    await self._wait_for_begin(journal, goal_id)
                else:
                    self._broker.add_note(subject, note.data)
                    note.done()

    def _has_room(self, journal: FleetJournal) -> bool:
        return journal.running > 0 and bool(self._membership.incarnation)

    async def _taken(
        self, journal: FleetJournal, others: NotesForOthers, note: Note, *, is_left: bool
    ) -> GoalID | None:
        """Take the goal of a note, if it is left or waits elsewhere, and return its ID; None if it
        is not taken.
        """
        names = self._names
        subject = names.left(journal.action) if is_left else names.want(journal.action)
        try:
            found = await self._found(journal, note)
            if not is_left and found is not None and journal.waits(found[1].goal.goal_id):
                return None  # it waits here; the note comes again
            if found is None or not (
                await self._lost.is_gone(found[1]) if is_left else found[1].waits
            ):
                note.done()
                return None
            record, entry = found
            goal_id, former = entry.goal.goal_id, entry.goal.worker
            if others.give_back(subject, note, entry.goal, is_left=is_left):
                return None
            is_taken = await journal.take(record, entry.goal)
        except BrokerAway:
            return None  # the note comes again
        if is_taken or self._membership.incarnation:
            note.done()
        if not is_taken:
            return None
        logger.info("goal %s of %r is taken over from %r", goal_id, journal.action, former)
        if former and not is_left:
            self._broker.publish(names.taken(former), record.subject.encode())
        return goal_id

    async def _found(
        self, journal: FleetJournal, note: Note
    ) -> tuple[BrokerRecord, GoalEntry] | None:
        """Return the record of the active goal of a note; None if there is none.

        Raises:
            BrokerAway: The brokers do not answer.
        """
        try:
            goal_id = GoalID(note.data)
        except ValueError:
            return None
        return await active_record(self._broker, self._names, journal.action, goal_id)

    async def _wait_for_begin(self, journal: FleetJournal, goal_id: GoalID | None) -> None:
        """Wait until a goal that was taken begins, and offer it to others if that takes long."""
        if goal_id is None:
            return
        with move_on_after(BEGIN_TIMEOUT):
            while journal.waits(goal_id):
                await journal.begun.wait()
        journal.offer_to_others(goal_id)

    # Hints

    def _on_hint(self, message: Message) -> None:
        try:
            subject = message.data.decode("ascii")
            journal = self._journals.by_action.get(action_of(subject))
            goal_id = GoalID(bytes.fromhex(last_token(subject)))
        except (ValueError, IndexError):
            return
        if journal is not None and journal.waits(goal_id):
            self._journals.tasks.start_soon(self._look_at, journal, goal_id)

    async def _look_at(self, journal: FleetJournal, goal_id: GoalID) -> None:
        """Let go of a goal if its record has another owner."""
        try:
            found = await active_record(self._broker, self._names, journal.action, goal_id)
        except BrokerAway:
            return  # the begin of the goal will be refused
        if found is not None and found[1].incarnation != self._membership.incarnation:
            journal.lose(goal_id)

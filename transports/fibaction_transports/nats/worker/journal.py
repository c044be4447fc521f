"""`FleetJournal`: the goals of one action at one worker, as the brokers keep them.

Theory of operation
-------------------

The record of a goal is its ownership. Each write replaces the record whose sequence the worker
knows, and is refused if there is another by now: then the goal belongs to another worker
(`GoalTaken`). `record_writes` has the order of writes, and the rule for one without an answer.

A goal that waits adds a note to the queue `want`, and a goal that is released one to `left`, so
that other workers find it: see `takeover`.
"""

from __future__ import annotations

import random
import time
from collections.abc import Awaitable, Callable

from anyio import current_time, sleep
from anyio.abc import TaskGroup

from fibaction.border.abc import Notifier
from fibaction.border.goal_store import GoalJournal, KeySlots, StoredGoal, Then
from fibaction.words.errors import StoreError, TransportError
from fibaction.words.goals import GoalID
from fibaction_transports.nats.broker.broker import (
    Broker,
    BrokerAway,
    BrokerRecord,
    PutError,
    PutFailure,
)
from fibaction_transports.nats.fleet_history import FleetHistory, HistoryWrites
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import ROOM_TO_GROW, LeaseEntry, time_to_live
from fibaction_transports.nats.worker.lease import MemberPart, Membership
from fibaction_transports.nats.worker.record_writes import (
    IS_STORED,
    AnswerQueue,
    HeldGoal,
    KeptOutcomes,
    Shortage,
    Write,
    taken,
    too_large,
)

INTAKE_PERIOD = 10.0
"""Seconds after which a worker looks whether another one has noted a pause; clients that pause an
action ask all workers to look."""
INTAKE_PATIENCE, INTAKE_PAUSE = 15.0, 0.2
"""Seconds for which brokers may agree on the leader of a stream, and between two questions."""
INTAKE_TRIES = 50
"""Times that a worker tries to change it, if others do so at the same time."""
CLASH_PAUSE = 0.02
"""Seconds until it tries again, at most."""


class FleetJournal(FleetHistory, GoalJournal):
    """The goals of one action at one worker."""

    def __init__(
        self,
        parts: WorkerJournals,
        action: str,
        max_results: int,
        claim: Callable[[StoredGoal], None],
        lose: Callable[[GoalID], None],
        obstacle: Callable[[StoredGoal], str],
        key_slots: Callable[[str, int], Awaitable[KeySlots]],
        make_keys: Callable[[], Awaitable[None]],
    ) -> None:
        self._make_keys = make_keys
        super().__init__(parts.broker, parts.names, action)
        self.running = 0.0
        """The number of goals that the server can run now."""
        self.waiting = 0.0
        """The number of goals that have room in its queue."""
        self._parts = parts
        self._membership = parts.membership
        self._claim = claim
        self._lose = lose
        self.obstacle = obstacle
        """The function that returns why the server cannot run a goal; empty if it can."""
        self._held: dict[GoalID, HeldGoal] = {}
        self._key_slots = key_slots
        self._shortage = Shortage(parts.names)
        self.outcomes = KeptOutcomes(parts.broker, max_results)
        self._keeps_waiting = False  # True if goals wait for slots in the fleet
        self._settled = Notifier()
        self._answers = AnswerQueue(self._settled.notify)
        self.begun = Notifier()
        """Notifies of each goal that does not wait any longer."""

    @property
    def valid_until(self) -> float:
        """See `GoalJournal.valid_until`."""
        return self._membership.valid_until

    def set_capacity(self, running: float, waiting: float) -> None:
        """See `GoalJournal.set_capacity`."""
        self.running, self.waiting = running, waiting
        self._parts.room.notify()

    async def key_slots(self, limit: str, most: int) -> KeySlots:
        """See `GoalJournal.key_slots`."""
        self._keeps_waiting = True
        return await self._key_slots(limit, most)

    # The intake

    intake_period = INTAKE_PERIOD

    async def intake(self) -> bytes:
        """See `IntakeSource.intake`. What was lost with its stream is kept again."""
        record = await self._kept_intake()
        if record is None and self._intake:
            return await self.change_intake(lambda kept: kept or self._intake)
        self._intake = b"" if record is None else record.data
        return self._intake

    async def _kept_intake(self) -> BrokerRecord | None:
        # The brokers of a stream that was made just now may still agree on its leader.
        ends = current_time() + INTAKE_PATIENCE
        while True:
            try:
                return await self._broker.get(self._names.keys, self._names.intake(self.action))
            except BrokerAway as exc:
                if current_time() >= ends:
                    raise StoreError(f"the intake cannot be read: {exc}") from exc
            await sleep(INTAKE_PAUSE)

    async def change_intake(self, change: Callable[[bytes], bytes]) -> bytes:
        """See `IntakeSource.change_intake`."""
        subject = self._names.intake(self.action)
        try:
            await self._make_keys()
            for _ in range(INTAKE_TRIES):
                record = await self._broker.get(self._names.keys, subject)
                before, sequence = (b"", 0) if record is None else (record.data, record.sequence)
                self._intake = change(before)
                if self._intake == before:
                    return before
                answer = await self._broker.put_and_wait(subject, self._intake, expected=sequence)
                if not isinstance(answer, PutError):
                    return self._intake
                if answer.kind not in (PutFailure.REFUSED, PutFailure.UNKNOWN):
                    raise StoreError(answer.text)
                await sleep(random.uniform(0, CLASH_PAUSE))  # another worker was faster
        except (BrokerAway, TransportError) as exc:
            raise StoreError(f"the intake cannot be kept: {exc}") from exc
        raise StoreError("the intake cannot be kept: too many others change it")

    # Writes

    def accept(self, goal: StoredGoal, then: Then) -> None:
        """See `GoalJournal.accept`."""
        if self._shortage or goal.goal_id in self._held:
            # In the second case, it is being taken over, and the server will be given it.
            error = self._shortage.error() if self._shortage else taken(goal.goal_id)
            self._answers.answer(self._new_write("accept", goal, then), error)
            return
        held = self._held[goal.goal_id] = HeldGoal(goal.goal_id, 0, goal)
        held.waits = not goal.is_running
        self._write("accept", goal, then)

    def begin(self, goal: StoredGoal, then: Then) -> None:
        """See `GoalJournal.begin`."""
        self._write("begin", goal, then)
        self.begun.notify()

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

    def _write(self, kind: str, goal: StoredGoal, then: Then) -> None:
        write = self._new_write(kind, goal, then)
        held = self._held.get(goal.goal_id)
        if held is None:
            self._answers.answer(write, taken(goal.goal_id))
            return
        if kind in ("begin", "end"):
            held.waits = False
        held.writes.append(write)
        if len(held.writes) == 1:
            self._send(held)

    def _new_write(self, kind: str, goal: StoredGoal, then: Then) -> Write:
        """Return a write of a goal, and take its turn among the answers."""
        membership = self._membership
        write = Write(kind, goal, membership.worker, membership.incarnation, then)
        self._answers.add(write)
        return write

    def _send(self, held: HeldGoal) -> None:
        """Send the first write of a goal."""
        write = held.writes[0]
        if not self._membership.check() or self._membership.incarnation != write.incarnation:
            self._taken_away(held)
            return
        spare = ROOM_TO_GROW if write.kind in ("accept", "checkpoint") else 0
        if len(write.data) > self._broker.max_record - spare:
            self._answered(held, write, PutError(PutFailure.TOO_LARGE, ""))
            return
        subject = self._names.goal(self.action, held.goal_id)
        least, ttl = self._parts.history.least_ttl, None
        if write.kind == "end":
            ttl = time_to_live(write.stored, time.time_ns(), least)

        def answered(answer: int | PutError) -> None:
            if held.is_first(write):
                self._answered(held, write, answer)

        self._broker.put(subject, write.data, expected=held.sequence, ttl=ttl, then=answered)

    def _answered(self, held: HeldGoal, write: Write, answer: int | PutError) -> None:
        if isinstance(answer, int):
            self._stored(held, write, answer)
        elif answer.kind is PutFailure.TOO_LARGE:
            self._failed(held, write, too_large(write, self._broker.max_record))
        elif answer.kind is PutFailure.FULL:
            error = self._shortage.failure_of(write, answer.text)
            if error is not None:
                self._failed(held, write, error)
            else:
                self._parts.tasks.start_soon(self._send_later, held, write)
        else:
            self._parts.tasks.start_soon(self._clear_doubt, held, write)

    async def _send_later(self, held: HeldGoal, write: Write) -> None:
        """Send the first write of a goal again after a pause."""
        await sleep(write.next_pause())
        if held.is_first(write):
            self._send(held)

    def _stored(self, held: HeldGoal, write: Write, sequence: int) -> None:
        """Note that the first write of a goal is stored, and send the next one."""
        before, held.stored, held.sequence = held.stored, write.stored, sequence
        held.writes.popleft()
        self._shortage.discard(held.goal_id)
        if write.kind == "end":
            self._forget(held)
            self.outcomes.add(self._names.goal(self.action, held.goal_id), held)
            self._parts.history.add(self.action, held.stored, before)
        elif write.kind == "release":
            self._forget(held)
            self._broker.add_note(self._names.left(self.action), bytes(held.goal_id))
        elif write.kind == "accept" and held.waits:
            self.offer_to_others(held.goal_id)
        self._answers.answer(write, None)
        if held.writes:
            self._send(held)

    def offer_to_others(self, goal_id: GoalID) -> None:
        """Add a note for workers with room, if a goal waits here for a slot of this worker. One
        that waits for a slot in the fleet, or until it can run alone, would wait as long at
        another worker, and go round.
        """
        held = self._held.get(goal_id)
        if held is None or not held.waits:
            return
        if not self._keeps_waiting and not held.stored.is_suspect:
            self._broker.add_note(self._names.want(self.action), bytes(goal_id))

    def _failed(self, held: HeldGoal, write: Write, error: StoreError) -> None:
        """Give up the first write of a goal, whose record is as before."""
        held.writes.popleft()
        if write.kind == "accept" and not held.writes:
            self._forget(held)
        self._answers.answer(write, error)
        if held.writes:
            self._send(held)

    def _taken_away(self, held: HeldGoal) -> None:
        """Answer all writes of a goal that belongs to another worker."""
        self._forget(held)
        while held.writes:
            self._answers.answer(held.writes.popleft(), taken(held.goal_id))

    def _forget(self, held: HeldGoal) -> None:
        if self._held.get(held.goal_id) is held:
            del self._held[held.goal_id]
            self._shortage.discard(held.goal_id)
        self._settled.notify()
        self.begun.notify()

    # Doubt

    async def _clear_doubt(self, held: HeldGoal, write: Write) -> None:
        """Find out whether a write is stored, and write it again if it is not."""
        while held.is_first(write):
            if not self._membership.check() or self._membership.incarnation != write.incarnation:
                self._taken_away(held)
                return
            subject = self._names.goal(self.action, held.goal_id)
            try:
                record = await self._broker.get(self._names.goals, subject)
            except BrokerAway:
                await sleep(write.next_pause())
                continue
            if not held.is_first(write):
                return
            sequence = held.sequence_for(write, record)
            if sequence is None:
                self._taken_away(held)
            elif record is not None and sequence == IS_STORED:
                self._stored(held, write, record.sequence)
            else:
                held.sequence = sequence
                await self._send_later(held, write)
            return

    # Goals that come and go

    def has(self, goal_id: GoalID) -> bool:
        """Return whether this worker has a goal."""
        return goal_id in self._held

    def waits(self, goal_id: GoalID) -> bool:
        """Return whether a goal waits at this worker."""
        held = self._held.get(goal_id)
        return held is not None and held.waits

    def __len__(self) -> int:
        return len(self._held)

    async def take(self, record: BrokerRecord, goal: StoredGoal) -> bool:
        """Take a goal over from its owner; return whether that was successful."""
        if goal.goal_id in self._held:
            return False
        former = goal.worker
        held = self._held[goal.goal_id] = HeldGoal(goal.goal_id, record.sequence, goal)
        held.waits = True
        answers: list[StoreError | None] = []
        news = Notifier()

        def then(error: StoreError | None) -> None:
            answers.append(error)
            news.notify()

        self._write("take", goal, then)
        while not answers:
            await news.wait()
        if answers[0] is not None or goal.goal_id not in self._held:
            self._forget(held)
            return False
        goal.worker = former
        self._claim(goal)
        return True

    def lose(self, goal_id: GoalID) -> None:
        """Let go of a goal that another worker has."""
        held = self._held.get(goal_id)
        if held is not None:
            self._lose(goal_id)
            self._taken_away(held)

    def lose_all(self) -> None:
        """Let go of all goals: they do not belong to this worker any longer."""
        for goal_id in tuple(self._held):
            self.lose(goal_id)

    async def settle(self) -> None:
        """Wait until nothing is being written."""
        while self._answers:
            await self._settled.wait()

    async def release_rest(self) -> None:
        """Release the goals that are left when the server has stopped."""
        self._shortage.close()
        await self.settle()
        for held in tuple(self._held.values()):
            # They wait, or were claimed and not begun: whoever takes them decides.
            self._write("release", held.stored, lambda _error: None)
        await self.settle()

    # Lost streams

    def rewrite_all(self) -> None:
        """Write the records of all goals again: their stream was lost, and there is a new one."""
        self.outcomes.forget()
        for held in tuple(self._held.values()):
            held.sequence = 0
            if not held.writes:  # otherwise the write that is under way is repeated
                self._write("rewrite", held.stored, lambda _error: None)

    def offer_all(self) -> None:
        """Add the notes of all goals that wait here again, because they were lost."""
        for goal_id in tuple(self._held):
            self.offer_to_others(goal_id)


class WorkerJournals(MemberPart):
    """The journals of one worker that are open, and what they share."""

    def __init__(
        self, broker: Broker, names: FleetNames, membership: Membership, tasks: TaskGroup
    ) -> None:
        self.broker = broker
        self.names = names
        self.membership = membership
        self.tasks = tasks
        """The tasks of the worker."""
        self.room = Notifier()
        """Notifies of a change of the room of a server, or of the membership."""
        self.history = HistoryWrites(broker, names)
        """The goals that are added to the history of the fleet."""
        self.by_action: dict[str, FleetJournal] = {}
        """The journals that are open, by their actions."""
        self.has_goals_left = False
        """True if a server has stopped whose goals could not be released."""
        self.unreadable: dict[str, int] = {}
        """The number of goals without a worker that this one cannot run, by their actions."""
        membership.add(self)

    def describe(self, entry: LeaseEntry) -> None:
        """See `MemberPart.describe`."""
        entry.goals = sum(map(len, self.by_action.values()))

    def fenced(self) -> None:
        """See `MemberPart.fenced`."""
        for journal in self.by_action.values():
            journal.lose_all()
        self.room.notify()

    def joined(self) -> None:
        """See `MemberPart.joined`."""
        self.room.notify()

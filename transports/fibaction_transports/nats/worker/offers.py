"""`Offers`: the answers of a worker to clients that look for one with room.

A worker listens to the questions about an action only while its server has room, and the brokers
give each question to one of the workers that listen. So a worker with no room is not asked.
"""

from __future__ import annotations

import math

from anyio import sleep
from anyio.lowlevel import checkpoint

from fibaction.border.abc import Notifier
from fibaction.words.errors import ProtocolError
from fibaction_transports.nats.broker.broker import BrokerAway, BrokerSubscription, Message
from fibaction_transports.nats.names import OFFER_GROUP
from fibaction_transports.nats.records import LeaseEntry, RoomOffer, encode, question
from fibaction_transports.nats.worker.journal import WorkerJournals
from fibaction_transports.nats.worker.lease import LONGEST_PAUSE, MemberPart

MOST = 16
"""The largest number of goals of one offer."""


class Offers(MemberPart):
    """The answers of one worker."""

    def __init__(self, journals: WorkerJournals) -> None:
        self._broker = journals.broker
        self._names = journals.names
        self._membership = journals.membership
        self._journals = journals
        self._open: dict[str, BrokerSubscription] = {}
        self._busy = 0  # the actions whose subscriptions are not as they should be
        self._ready = Notifier()
        self._membership.add(self)

    def describe(self, entry: LeaseEntry) -> None:
        """See `MemberPart.describe`: a worker has room if it listens to questions."""
        entry.has_room = bool(self._open)

    async def ready(self) -> None:
        """Wait until the worker listens to all questions for which it has room."""
        await checkpoint()  # the tasks begin
        while self._busy:
            await self._ready.wait()

    async def run(self, action: str) -> None:
        """Listen to questions about an action while there is room, until canceled."""
        subjects = self._names.offer(action), self._names.queue(action)
        try:
            while True:
                changes = [
                    (subject, room > 0)
                    for subject, room in zip(subjects, self._room(action), strict=True)
                    if (room > 0) != (subject in self._open)
                ]
                if not changes:
                    await self._journals.room.wait()
                self._busy += 1
                try:
                    for subject, listens in changes:
                        await self._listen(action, subject, listens=listens)
                finally:
                    self._busy -= 1
                    self._ready.notify()
        finally:
            for subject in subjects:
                self._close(subject)

    def _room(self, action: str) -> tuple[float, float]:
        """Return the room for goals that run, and for goals that wait."""
        if not self._membership.incarnation:
            return 0, 0
        journal = self._journals.by_action.get(action)
        return (math.inf, 0) if journal is None else (journal.running, journal.waiting)

    async def _listen(self, action: str, subject: str, *, listens: bool) -> None:
        if not listens:
            self._close(subject)
            return

        def answer(message: Message) -> None:
            self._answer(action, message)

        try:
            self._open[subject] = await self._broker.subscribe(subject, answer, OFFER_GROUP)
        except BrokerAway:
            await sleep(LONGEST_PAUSE)
        self._membership.note_change()

    def _close(self, subject: str) -> None:
        subscription = self._open.pop(subject, None)
        if subscription is not None:
            subscription.close()
            self._membership.note_change()

    def _answer(self, action: str, message: Message) -> None:
        try:
            asked = question(message.data)
        except ProtocolError:
            return
        # Without room by now, one goal is sent here, and then elsewhere.
        goals = max(1, min(asked.goals, MOST, sum(self._room(action))))
        self._broker.publish(message.reply, encode(RoomOffer(self._membership.worker, int(goals))))

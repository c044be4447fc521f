"""`HistoryWrites`: the goals that one worker adds to the history of its fleet.

Theory of operation
-------------------

The end of a goal is told when its record is stored, and that record stays for a minute at least.
The goal is added to the history afterwards, in the background, by a copy of the record together
with the request, which the record of an end does not have. A write that has no answer is made
again; it stores the goal only if the history does not have it, so it is there once.

A worker may be killed between the two. Then another one that finds the record of the end, while it
clears up after the lost worker or looks for goals without one, adds the goal, without its request.

A history that cannot be written must not stop the fleet. A goal for which there is no room is left
out with a line in the log, and so are those that end while too much waits to be added.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from copy import copy
from typing import NamedTuple, TypeAlias

from anyio import move_on_after, sleep
from anyio.abc import TaskGroup

from fibaction.border.abc import Notifier
from fibaction.border.goal_store import StoredGoal
from fibaction.border.peer_text import clean_logger
from fibaction_transports.nats.broker.broker import Broker, BrokerRecord, PutError, PutFailure
from fibaction_transports.nats.names import FleetNames, action_of
from fibaction_transports.nats.records import GoalEntry, encode

FIRST_PAUSE, LONGEST_PAUSE = 0.02, 1.0
"""Seconds until a write without an answer is made again."""
MOST_WAITING = 2**24
"""Bytes of goals that wait to be added, at most."""
LAST_WRITES = 5.0
"""Seconds that a worker that leaves waits for goals to be added."""
CLEARING = 10.0
"""Seconds within which the others read all records after a worker is lost."""
MOST_SEEN = 10_000
"""Records of goals of lost workers that are remembered as added."""

IsGone: TypeAlias = Callable[[GoalEntry], Awaitable[bool]]
"""Returns whether the worker of a goal is gone."""

logger = clean_logger("fibaction.nats")


class _Past(NamedTuple):
    """A goal that is to be added."""

    subject: str
    head: bytes
    data: bytes

    @property
    def size(self) -> int:
        return len(self.head) + len(self.data)


class HistoryWrites:
    """The goals that one worker adds to the history."""

    def __init__(self, broker: Broker, names: FleetNames) -> None:
        self.least_ttl = 1.0
        """Seconds for which the record of an end is kept at least."""
        self._tasks: TaskGroup | None = None
        self._broker = broker
        self._names = names
        self._waiting: dict[str, _Past] = {}  # by subject
        self._size = 0  # their bytes
        self._is_short = False  # goals are left out
        self._seen: set[int] = set()  # the sequences of records whose goals were added
        self._settled = Notifier()

    def open(self, tasks: TaskGroup, lease: float) -> None:
        """Add goals from now on; without this, none are added."""
        self._tasks = tasks
        self.least_ttl = 2 * lease + CLEARING  # so that others find the ends of a lost worker

    def add(self, action: str, ended: StoredGoal, sent: StoredGoal) -> None:
        """Add a goal that has ended, with the request and the meta that it had before."""
        if self._tasks is None:
            return
        past = copy(ended)
        past.goal, past.meta, past.checkpoint = sent.goal, sent.meta, None
        head = encode(past.listed())
        most = self._broker.max_record - 2 * len(head)  # it is sent as text
        if len(data := encode(past)) > most:
            past.goal = b""
            data = encode(past)
        if len(data) > most:
            past.result = None
            data = encode(past)
        self._add(_Past(self._names.past(action, past.goal_id, past.stamp), head, data))

    async def add_left(self, record: BrokerRecord, entry: GoalEntry, is_gone: IsGone) -> None:
        """Add the goal of a record if it has ended, and its worker is gone, which may not have
        added it.

        Raises:
            BrokerAway: The brokers do not answer.
        """
        goal = entry.goal
        if self._tasks is None or not goal.ended_at or record.sequence in self._seen:
            return
        if await is_gone(entry):
            if len(self._seen) >= MOST_SEEN:
                self._seen.clear()  # it is harmless to add them again
            self._seen.add(record.sequence)
            self.add(action_of(record.subject), goal, goal)

    def _add(self, past: _Past) -> None:
        if self._waiting and self._size + past.size > MOST_WAITING:
            self._leave_out("too many goals wait to be added")
        elif past.subject not in self._waiting:
            self._waiting[past.subject] = past
            self._size += past.size
            self._send(past, FIRST_PAUSE)

    def _send(self, past: _Past, pause: float) -> None:
        def answered(answer: int | PutError) -> None:
            if isinstance(answer, PutError) and answer.kind is PutFailure.UNKNOWN:
                assert self._tasks is not None
                self._tasks.start_soon(self._send_again, past, pause)
                return
            if isinstance(answer, int):
                self._is_short = False
            elif answer.kind is not PutFailure.REFUSED:  # then it is there already
                self._leave_out(answer.text)
            self._forget(past)

        self._broker.put(past.subject, past.data, expected=0, head=past.head, then=answered)

    async def _send_again(self, past: _Past, pause: float) -> None:
        await sleep(pause)
        self._send(past, min(2 * pause, LONGEST_PAUSE))

    def _forget(self, past: _Past) -> None:
        del self._waiting[past.subject]
        self._size -= past.size
        if not self._waiting:
            self._settled.notify()

    def _leave_out(self, why: str) -> None:
        if not self._is_short:
            self._is_short = True
            logger.warning(
                "goals that end now may be missing in the history of fleet %r: %s (stream %s)",
                self._names.fleet,
                why,
                self._names.history,
            )

    async def settle(self) -> None:
        """Wait until all goals are added, for some seconds at most."""
        with move_on_after(LAST_WRITES):
            while self._waiting:
                await self._settled.wait()

"""`Turns`: executors that do not wait run one after another, each for a slice of time.

Otherwise a turn of the event loop would take a slice for each of them, and a client with many goals
would have as much time as all others together.

`FairQueue` makes a server fair between clients: a key is a client (`Sender.owner`), and an item a
goal that is to begin (`task_pool`), or an executor that has used its slice up. For fairness between
connections, see `fibaction.wire.server.session_goals`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from typing import Generic, TypeVar

from anyio import Event
from anyio.lowlevel import checkpoint

T = TypeVar("T")

EXECUTOR_SLICE = 0.005
"""Seconds that a task may run without awaiting before other tasks run: short for people and for
heartbeats, long compared with a turn of the event loop (about 10 microseconds)."""

FEW = 20
"""Executors that may wait with whole slices: 0.1 s until each has had its turn."""


class FairQueue(Generic[T]):
    """A queue in which each key has its turn, however many items another key has.

    Each operation takes the same time for any number of items and keys. Only keys with items take
    memory, besides one.
    """

    __slots__ = ("_items", "_turns", "count")

    def __init__(self) -> None:
        self._items: dict[Hashable, deque[T]] = {}
        self._turns: deque[tuple[Hashable, deque[T]]] = deque()
        self.count = 0
        """The number of items; an attribute, since a pool reads it at each wait of a job."""

    def append(self, item: T, key: Hashable) -> None:
        """Add an item after those of the same key."""
        items = self._items.get(key)
        if items is None:
            items = self._items[key] = deque()
            self._turns.append((key, items))
        items.append(item)
        self.count += 1

    def popleft(self) -> T:
        """Remove and return the next item: the oldest one of the key whose turn it is.

        Raises:
            IndexError: The queue is empty.
        """
        turns = self._turns
        if len(turns) > 1:
            key, items = turns.popleft()
            while not items:  # the last key that was alone
                del self._items[key]
                key, items = turns.popleft()
            item = items.popleft()
            if items:
                turns.append((key, items))
            else:
                del self._items[key]
        else:
            # A key that is alone stays: to remove it would cost more than to take its item.
            item = turns[0][1].popleft()
        self.count -= 1
        return item


class Turns:
    """The executors of a server that have used their slice up, and wait for the next one.

    In each turn of the event loop one of them continues: the one that was woken wakes the next,
    which runs in the next turn. Keys take turns. The more executors wait, the shorter are their
    slices, so that none waits for long, also for executors of other keys.
    """

    def __init__(self) -> None:
        self._waiting: FairQueue[Event] = FairQueue()
        self._gone: set[Event] = set()  # those that were canceled, and are still in the queue
        self._is_passing = False
        self.slice = EXECUTOR_SLICE
        """The seconds of a slice that begins now: fewer if many wait."""

    async def pause(self, key: Hashable) -> None:
        """Let other tasks run, and wait for the next slice."""
        if not self._is_passing:
            self._is_passing = True
            try:
                await checkpoint()
            finally:
                self._pass_on()
            return
        event = Event()
        self._waiting.append(event, key)
        self._cut()
        try:
            await event.wait()
        finally:
            if event.is_set():
                self._pass_on()
            else:
                self._gone.add(event)

    def _cut(self) -> None:
        count = self._waiting.count
        self.slice = EXECUTOR_SLICE if count <= FEW else EXECUTOR_SLICE * FEW / count

    def _pass_on(self) -> None:
        while self._waiting.count:
            event = self._waiting.popleft()
            self._cut()
            if event not in self._gone:
                event.set()
                return
            self._gone.remove(event)
        self._is_passing = False

"""`FairQueue`: items in the order of their arrival for each key, with turns for the keys.

It makes a server fair between clients: a key is a client (`Sender.owner`), and an item a goal that
is to begin (`task_pool`), or an executor that has used its slice of time up (`turns`). Clients
take turns, however many goals each of them has. For fairness between connections, see
`fibaction.wire.server.session_goals`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from typing import Generic, TypeVar

T = TypeVar("T")


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

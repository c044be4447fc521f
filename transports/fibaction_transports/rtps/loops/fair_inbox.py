"""Datagrams that were read and not taken yet, one of each sender in turn."""

from __future__ import annotations

from collections import OrderedDict, deque

from fibaction_transports.rtps.messages.locators import Address

OVERHEAD = 256
"""Bytes that are counted for a datagram beside its content."""


class FairInbox:
    """Datagrams in the order in which they are taken.

    A sender that floods the sockets fills its own queue only: a datagram of another one waits for
    one of each sender, and not for all that came before it.
    """

    def __init__(self, limit: int, limit_of_one: int) -> None:
        """Keep so many bytes, and so many of one sender."""
        self._limit = limit
        self._limit_of_one = limit_of_one
        self._queues: OrderedDict[Address, _SenderQueue] = OrderedDict()
        self._size = 0

    def __bool__(self) -> bool:
        return bool(self._queues)

    def put(self, datagram: bytes, source: Address) -> bool:
        """Add a datagram; return False, and add none, if there is no room."""
        queue = self._queues.get(source)
        size = len(datagram) + OVERHEAD
        if queue is None:
            queue = _SenderQueue()
        if queue.size + size > self._limit_of_one or self._size + size > self._limit:
            return False
        self._queues[source] = queue
        queue.datagrams.append(datagram)
        queue.size += size
        self._size += size
        return True

    def take(self) -> tuple[bytes, Address]:
        """Take the next datagram, of which there is one."""
        source, queue = self._queues.popitem(last=False)
        datagram = queue.datagrams.popleft()
        size = len(datagram) + OVERHEAD
        queue.size -= size
        self._size -= size
        if queue.datagrams:
            self._queues[source] = queue
        return datagram, source


class _SenderQueue:
    """The datagrams of one sender."""

    __slots__ = ("datagrams", "size")

    def __init__(self) -> None:
        self.datagrams: deque[bytes] = deque()
        self.size = 0

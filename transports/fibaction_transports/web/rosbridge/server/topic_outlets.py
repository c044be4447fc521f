"""`FeedbackOutlet` and `StatusOutlet`: the messages of one topic on their way to one client.

A client limits a topic by `throttle_rate`, the time between two messages, and by `queue_length`,
the number of messages that wait for their time. Messages that find no room are dropped, the oldest
first. Statuses do not wait in a queue: a message has the statuses of all goals, so that only the
newest one counts, and that is never dropped.

These classes read no clock, and call nobody: their owner asks for `due`, and takes what is due.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from fibaction_transports.web.rosbridge.fragments import in_fragments, size_of
from fibaction_transports.web.rosbridge.operations import ClientID, Subscribe

LONGEST_PERIOD = 3600.0
"""Seconds between two messages of a topic, at most."""
LONGEST_QUEUE = 1000
"""Messages of a topic that wait for their time, at most."""
QUEUE_BYTES = 2**20
"""Bytes of the messages of one topic that wait for their time."""
STATUS_PERIOD = 2e-5
"""Seconds between two messages about statuses, for each goal in them: they have the whole list."""


class Outlet:
    """Base of both kinds of topics: the client's subscriptions, and the time of the next message.

    If a client has several subscriptions of one topic, it gets each message once, by the most
    demanding of them, as from rosbridge.
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        """The name of the topic, as the client has written it."""
        self.subscriptions: dict[ClientID, Subscribe] = {}
        self._period = 0.0
        self._most_waiting = 0
        self._fragment_size: int | None = None
        self._free_at = -math.inf

    def subscribe(self, sent: Subscribe) -> None:
        """Add a subscription, or replace the one of the same ID."""
        self.subscriptions[sent.id] = sent
        self._update()

    def unsubscribe(self, client_id: ClientID) -> None:
        """Remove a subscription; all of them without an ID."""
        if client_id is None:
            self.subscriptions.clear()
        else:
            self.subscriptions.pop(client_id, None)
        self._update()

    def _update(self) -> None:
        given = self.subscriptions.values()
        rate = min((one.throttle_rate for one in given), default=0.0)
        self._period = min(rate / 1000, LONGEST_PERIOD)
        waiting = min((one.most_waiting for one in given), default=0)
        self._most_waiting = min(waiting, LONGEST_QUEUE)
        sizes = (one.fragment_size for one in given if one.fragment_size is not None)
        self._fragment_size = min(sizes, default=None)

    def _fitting(self, text: str) -> list[str]:
        return in_fragments(text, f"publish:{self.topic}", self._fragment_size)


class FeedbackOutlet(Outlet):
    """The topic with the feedback of all goals of an action."""

    def __init__(self, topic: str) -> None:
        super().__init__(topic)
        self._queue: deque[str] = deque()
        self._bytes = 0

    @property
    def due(self) -> float:
        """The time of the next message that waits; infinite if none does."""
        return self._free_at if self._queue else math.inf

    def offer(self, text: str, now: float) -> list[str]:
        """Return a message that may be sent now; keep or drop it otherwise."""
        if not self._queue and now >= self._free_at:
            self._free_at = now + self._period
            return self._fitting(text)
        self._queue.append(text)
        self._bytes += size_of(text)
        while len(self._queue) > self._most_waiting or self._bytes > QUEUE_BYTES:
            self._bytes -= size_of(self._queue.popleft())
        return []

    def take(self, now: float) -> list[str]:
        """Return the messages that are due."""
        texts: list[str] = []
        while self._queue and now >= self._free_at:
            text = self._queue.popleft()
            self._bytes -= size_of(text)
            self._free_at = now + self._period
            texts += self._fitting(text)
        return texts


class StatusOutlet(Outlet):
    """The topic with the statuses of all goals of an action."""

    def __init__(self, topic: str) -> None:
        super().__init__(topic)
        self._has_news = False

    @property
    def due(self) -> float:
        """The time of the next message; infinite if there is nothing new."""
        return self._free_at if self._has_news else math.inf

    def note(self) -> None:
        """Note that there is something new."""
        self._has_news = True

    def take(self, now: float, count: int, make: Callable[[str], str]) -> list[str]:
        """Return the message, which `make` makes for a topic, about so many goals, if it is due."""
        if now < self.due:
            return []
        self._has_news = False
        self._free_at = now + max(self._period, count * STATUS_PERIOD)
        return self._fitting(make(self.topic))

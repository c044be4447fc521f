"""`WatchedAction`: the goals of one action, for the topics of one rosbridge client.

A client limits a topic by `throttle_rate`, the time between two messages, and by `queue_length`,
the number of messages that wait for their time. Messages that find no room are dropped, the oldest
first. Statuses do not wait in a queue: a message has the statuses of all goals, so that only the
newest one counts, and that is never dropped.

These classes read no clock: their owner asks for `due`, and takes what is due.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from functools import partial
from itertools import chain

from fibaction.wire.messages import (
    AwaitServer,
    Follow,
    GoalChanged,
    WatchStatus,
)
from fibaction_transports.web.rosbridge.operations import ClientID, Subscribe, Unsubscribe
from fibaction_transports.web.rosbridge.server.pending_calls import CREDIT, topic_statuses
from fibaction_transports.web.rosbridge.text_messages import in_fragments, size_of

LONGEST_PERIOD = 3600.0
"""Seconds between two messages of a topic, at most."""
LONGEST_QUEUE = 1000
"""Messages of a topic that wait for their time, at most."""
QUEUE_BYTES = 2**20
"""Bytes of the messages of one topic that wait for their time."""
STATUS_PERIOD = 2e-5
"""Seconds between two messages about statuses, for each goal in them: they have the whole list."""
MOST_ENDED = 100
"""Goals that have ended, and are in the list of statuses; the oldest of more are left out."""


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


Ask = Callable[["WatchedAction", Callable[[int], object]], int]
"""Asks the session with the message that is made for a number, and returns the number."""


class WatchedAction:
    """The goals of one action, and the topics that tell about them."""

    def __init__(self, action: str, ask: Ask, most_goals: int) -> None:
        """Follow at most so many goals at once."""
        self.action = action
        self.feedback: dict[str, FeedbackOutlet] = {}
        """The topics of feedback, by their names as the client has written them."""
        self.status: dict[str, StatusOutlet] = {}
        self.follows: dict[int, bytes] = {}
        """The IDs of the goals that are followed, by the requests."""
        self._followed: set[bytes] = set()
        self.request = 0
        """The request for the statuses, or the wait for the server."""
        self.begin_at = math.inf
        """The time at which the server is asked again; infinite while a request is open."""
        self._unlisted: int | None = None  # known goals that the session has still to tell
        self._ask = ask
        self._most_goals = most_goals
        self._active: dict[bytes, GoalChanged] = {}
        self._ended: dict[bytes, GoalChanged] = {}

    @property
    def subscriptions(self) -> int:
        """The number of the client's subscriptions."""
        outlets = chain(self.feedback.values(), self.status.values())
        return sum(len(one.subscriptions) for one in outlets)

    @property
    def is_listed(self) -> bool:
        """True if all known goals were told."""
        return self._unlisted == 0

    @property
    def due(self) -> float:
        """The time of the next message, or at which the server is asked again."""
        times = [self.begin_at, *(one.due for one in self.feedback.values())]
        if self.is_listed:
            times += [one.due for one in self.status.values()]
        return min(times)

    def begin(self, *, is_served: bool) -> None:
        """Ask for the statuses of the goals, or first wait until the action is served."""
        self.begin_at, self._unlisted = math.inf, None
        self._active, self._ended = {}, {}
        if is_served:
            self.request = self._ask(self, lambda id: WatchStatus(id, self.action, CREDIT))
        else:
            self.request = self._ask(self, lambda id: AwaitServer(id, self.action))

    def begin_list(self, known: int) -> None:
        """Take the number of known goals, which are told first."""
        self._unlisted = known
        self._note_statuses()

    def _note_statuses(self) -> None:
        for outlet in self.status.values():
            outlet.note()

    # Subscriptions

    def add(self, sent: Subscribe, *, statuses: bool) -> None:
        """Tell the statuses on a topic, first those that there are, or the feedback from now on."""
        if statuses:
            outlet = self.status.setdefault(sent.topic, StatusOutlet(sent.topic))
            outlet.subscribe(sent)
            outlet.note()
            return
        is_first = not self.feedback
        self.feedback.setdefault(sent.topic, FeedbackOutlet(sent.topic)).subscribe(sent)
        if is_first:
            for goal in self._active.values():
                self._follow(goal, None)

    def remove(self, sent: Unsubscribe) -> list[int]:
        """Remove subscriptions; return the follows that are not needed any longer."""
        for outlets in (self.feedback, self.status):
            outlet = outlets.get(sent.topic)
            if outlet is not None:
                outlet.unsubscribe(sent.id)
                if not outlet.subscriptions:
                    outlets.pop(sent.topic)
        return [] if self.feedback else self.leave_all()

    def leave_all(self) -> list[int]:
        """Follow no goal any longer; return the requests."""
        left = list(self.follows)
        self.follows.clear()
        self._followed.clear()
        return left

    def leave(self, request: int) -> None:
        """Forget a goal whose end was told, or which cannot be followed."""
        self._followed.discard(self.follows.pop(request, b""))

    # Goals

    def change(self, goal: GoalChanged) -> bool:
        """Take the status of a goal; return False if the goal cannot be followed any more."""
        before = self._active.pop(goal.goal_id, None) or self._ended.get(goal.goal_id)
        if goal.status.is_terminal:
            self._ended[goal.goal_id] = goal
            if len(self._ended) > MOST_ENDED:
                del self._ended[next(iter(self._ended))]
        else:
            self._active[goal.goal_id] = goal
        if before is None or before.status != goal.status:
            self._note_statuses()
        was_known = bool(self._unlisted)
        if self._unlisted:
            self._unlisted -= 1
        is_new = before is None and not (was_known and goal.status.is_terminal)
        if not (self.feedback and is_new):
            return True
        return self._follow(goal, None if was_known else 0)

    def _follow(self, goal: GoalChanged, after: int | None) -> bool:
        """Follow a goal from now on, or from its first feedback on."""
        if goal.goal_id in self._followed:
            return True
        if len(self.follows) >= self._most_goals:
            return False
        action, goal_id, attempt = self.action, goal.goal_id, goal.attempt
        request = self._ask(
            self, lambda id: Follow(id, action, goal_id, after, False, CREDIT, attempt)
        )
        self.follows[request] = goal.goal_id
        self._followed.add(goal.goal_id)
        return True

    # To the client

    def take(self, now: float) -> list[str]:
        """Return the messages that are due."""
        texts: list[str] = []
        for outlet in self.feedback.values():
            texts += outlet.take(now)
        if self.is_listed:
            goals = len(self._active) + len(self._ended)
            for one in self.status.values():
                all_goals = chain(self._ended.values(), self._active.values())
                texts += one.take(now, goals, partial(topic_statuses, goals=all_goals))
        return texts

"""`Topics`: the topics of actions to which one rosbridge client subscribes.

An action has two topics, as in ROS, about the goals of all clients:

    <action>/_action/feedback   the feedback of all goals, from the moment of the subscription on
    <action>/_action/status     the statuses of all goals, at once and whenever one changes

Theory of operation
-------------------

Both are made of what the session of the client tells any client over the wire protocol, so that
permissions and limits are the same. `Topics` asks for the statuses of an action once, for as long
as the client has a topic of it. For the feedback it follows each goal that is active, and each that
comes, as one that another client has sent: such a follower makes no executor wait, and misses
feedback if it reads slowly.

The requests of topics have numbers of their own, from `FIRST_REQUEST` on, so that answers to
requests that were closed meanwhile are known, and ignored.

If the actions are those of a server behind this one, their statuses end with the connection to it.
Then `Topics` waits for that server, and asks again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import count

import anyio
import msgspec

from fibaction.border.abc import Endpoint, Notifier
from fibaction.border.peer_text import excerpt
from fibaction.schema.payload import PayloadError
from fibaction.wire.messages import (
    Close,
    Credit,
    Done,
    Ended,
    Failed,
    Feedback,
    Finished,
    FromServer,
    GoalChanged,
    Received,
    Watching,
    Why,
    encode,
)
from fibaction_transports.web.rosbridge.operations import Subscribe, Unsubscribe
from fibaction_transports.web.rosbridge.server.pending_calls import CREDIT, topic_feedback
from fibaction_transports.web.rosbridge.server.rosapi import (
    FEEDBACK_SUFFIX,
    STATUS_SUFFIX,
    known_name,
    short_type,
    topic_types,
)
from fibaction_transports.web.rosbridge.server.watched_action import WatchedAction

FIRST_REQUEST = 2**32
"""The number of the first request of topics; those of other requests are smaller."""
MOST_SUBSCRIPTIONS = 100
"""Subscriptions of one connection."""
RETRY_AFTER = 1.0
"""Seconds after which a server is asked again whose statuses have ended."""


class _Request(msgspec.Struct):
    """A request to the session that is open."""

    watched: WatchedAction
    told: int = 0
    """Messages that have used up credit."""


class Topics:
    """The subscriptions of one connection."""

    def __init__(
        self,
        endpoints: Mapping[str, Endpoint],
        most_goals: int,
        note: Callable[[str], None],
        clock: Callable[[], float] = anyio.current_time,
    ) -> None:
        """Follow at most so many goals at once, and let `note` log something once."""
        self._endpoints = endpoints
        self._most_goals = most_goals
        self._note = note
        self._clock = clock
        self._requests = count(FIRST_REQUEST)
        self._actions: dict[str, WatchedAction] = {}
        self._open: dict[int, _Request] = {}
        self._frames: list[bytes] = []
        self._changed = Notifier()

    # From the client

    def subscribe(self, sent: Subscribe) -> list[bytes]:
        """Return the frames for the session that a subscription needs."""
        problem = self._problem_of(sent)
        if problem:
            self._note(f"the topic {excerpt(sent.topic)!r} is not served: {problem}")
            return []
        action = known_name(action_of(sent.topic), self._endpoints)
        watched = self._actions.get(action)
        if watched is None:
            watched = self._actions[action] = WatchedAction(action, self._ask, self._most_goals)
            watched.begin(is_served=action in self._endpoints)
        watched.add(sent, statuses=sent.topic.endswith(STATUS_SUFFIX))
        return self._taken()

    def _problem_of(self, sent: Subscribe) -> str:
        """Return why a subscription is ignored; empty if it is not."""
        name = action_of(sent.topic)
        if not name:
            return f"there are only ACTION{FEEDBACK_SUFFIX} and ACTION{STATUS_SUFFIX}"
        if sum(one.subscriptions for one in self._actions.values()) >= MOST_SUBSCRIPTIONS:
            return f"a connection has at most {MOST_SUBSCRIPTIONS} subscriptions"
        endpoint = self._endpoints.get(known_name(name, self._endpoints))
        if endpoint is None or not sent.type:
            return ""
        kind = topic_types(endpoint.info)[sent.topic.endswith(STATUS_SUFFIX)]
        if not kind or short_type(kind) == short_type(sent.type):
            return ""
        return f"its type is {kind}, and not {excerpt(sent.type)}"

    def unsubscribe(self, sent: Unsubscribe) -> list[bytes]:
        """Return the frames for the session that end what is not needed any longer."""
        action = known_name(action_of(sent.topic), self._endpoints)
        watched = self._actions.get(action)
        if watched is not None:
            self._leave(watched.remove(sent))
            if not watched.subscriptions:
                self._forget(watched)
        return self._taken()

    def _ask(self, watched: WatchedAction, make: Callable[[int], object]) -> int:
        """Ask the session, with the message that `make` makes for the number of the request."""
        request = next(self._requests)
        self._open[request] = _Request(watched)
        self._frames.append(encode(make(request)))
        return request

    def _forget(self, watched: WatchedAction) -> None:
        self._leave(watched.leave_all())
        del self._actions[watched.action]
        if self._open.pop(watched.request, None) is not None:
            self._frames.append(encode(Close(watched.request)))

    def _leave(self, follows: list[int]) -> None:
        """Follow these goals no longer."""
        for number in follows:
            del self._open[number]
            self._frames.append(encode(Received(number)))

    def _taken(self) -> list[bytes]:
        self._changed.notify()
        return self.take_replies()

    # From the session

    def is_about(self, message: FromServer) -> bool:
        """Return whether a frame of the session is about topics."""
        return getattr(message, "id", 0) >= FIRST_REQUEST

    def texts_of(self, message: FromServer) -> list[str]:
        """Return the messages for the client that a frame about topics is."""
        number: int = getattr(message, "id", 0)
        request = self._open.get(number)
        if request is None:
            return []  # it was closed
        watched = request.watched
        texts: list[str] = []
        if isinstance(message, Feedback):
            self._count(number, request)
            texts = self._feedback(watched, message)
        elif isinstance(message, Watching):
            watched.begin_list(message.known)
        elif isinstance(message, GoalChanged):
            self._count(number, request)
            if not watched.change(message):
                action, most = excerpt(watched.action), self._most_goals
                self._note(f"it follows {most} goals of the action {action!r}, and no more")
        elif isinstance(message, Done | Finished | Ended | Failed):
            del self._open[number]
            self._end(watched, message)
        self._changed.notify()
        return texts

    def _count(self, number: int, request: _Request) -> None:
        """Count a message that has used up credit, and give more in time."""
        request.told += 1
        if request.told % CREDIT == 0:
            self._frames.append(encode(Credit(number, CREDIT)))

    def _feedback(self, watched: WatchedAction, message: Feedback) -> list[str]:
        try:
            message_text = topic_feedback(watched.follows[message.id], message.payload)
        except PayloadError as exc:
            self._note(f"feedback of the action {watched.action!r} is left out: {exc}")
            return []
        now = self._clock()
        texts: list[str] = []
        for outlet in watched.feedback.values():
            texts += outlet.offer(message_text(outlet.topic), now)
        return texts

    def _end(self, watched: WatchedAction, message: Done | Finished | Ended | Failed) -> None:
        """Continue after the last frame of a request."""
        if message.id != watched.request:
            watched.leave(message.id)
        elif isinstance(message, Done):
            watched.begin(is_served=True)
        elif isinstance(message, Finished) or (
            isinstance(message, Failed) and message.why == Why.CONNECTION_LOST
        ):
            watched.begin_at = self._clock() + RETRY_AFTER
        else:
            assert isinstance(message, Failed)
            action, text = excerpt(watched.action), excerpt(message.text)
            self._note(f"the topics of the action {action!r} are not served: {text}")
            self._forget(watched)

    # To the client, in time

    @property
    def _due(self) -> float:
        return min((watched.due for watched in self._actions.values()), default=math.inf)

    @property
    def has_texts(self) -> bool:
        """True if there are messages to take, or frames."""
        return bool(self._frames) or (bool(self._actions) and self._due <= self._clock())

    def take_texts(self) -> list[str]:
        """Return the messages that are due."""
        if not self._actions:
            return []
        texts: list[str] = []
        now = self._clock()
        for watched in self._actions.values():
            if watched.begin_at <= now:
                watched.begin(is_served=False)
            texts += watched.take(now)
        self._changed.notify()
        return texts

    def take_replies(self) -> list[bytes]:
        """Return the frames for the session."""
        frames, self._frames = self._frames, []
        return frames

    async def run(self, wake: Callable[[], None]) -> None:
        """Call `wake` whenever there is something to take; run until canceled."""
        while True:
            due = self._due
            if due <= self._clock():
                wake()
                due = math.inf
            with anyio.CancelScope(deadline=due):
                await self._changed.wait()


def action_of(topic: str) -> str:
    """Return the name of the action whose topic it is; empty if it is not a topic of an action."""
    for suffix in (FEEDBACK_SUFFIX, STATUS_SUFFIX):
        if topic.endswith(suffix):
            return topic.removesuffix(suffix)
    return ""

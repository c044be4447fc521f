"""`SessionGoals`: the goals that one client sends and follows over one connection.

Most goals need no task here: `offer_goal` often has an answer at once, and what there is to tell is
fetched by the link, which asks `next_frames` when the line can take more. A goal whose stream has
news is *ready*, and the ready goals take turns.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextlib import AbstractContextManager
from typing import TypeAlias

from anyio.abc import TaskGroup

from fibaction._notify import Notifier
from fibaction.abc import Endpoint, GoalStream
from fibaction.exceptions import GoalRejected, UnknownGoal
from fibaction.goals import GoalID
from fibaction.wire.auth import Permission
from fibaction.wire.channel import CHUNK
from fibaction.wire.link import Link
from fibaction.wire.messages import Follow, Received, SendGoal
from fibaction.wire.ownership import Owners
from fibaction.wire.session_client import SessionClient
from fibaction.wire.settings import Limits
from fibaction.wire.subscriptions import GoalSubscription

GoalRequest: TypeAlias = SendGoal | Follow
Answering: TypeAlias = Callable[[GoalRequest], AbstractContextManager[None]]
"""Turns any error of a block into the answer to a request."""


def too_much(limits: Limits) -> str:
    """Return the sentence for a client that has reached the limits of its connection."""
    return (
        f"too much at once: the limits of a connection are {limits.goals} goals"
        f" and {limits.requests} other requests"
    )


class SessionGoals:
    """The goals of one connection, by the IDs of their requests."""

    def __init__(
        self,
        client: SessionClient,
        owners: Owners,
        limits: Limits,
        link: Link,
        answering: Answering,
    ) -> None:
        self.tasks: TaskGroup
        self._client = client
        self._owners = owners
        self._limits = limits
        self._link = link
        self._answering = answering
        self._open: dict[int, GoalSubscription] = {}
        self._follows: dict[bytes, int] = {}  # the number of them for each goal
        self._ready: dict[GoalSubscription, None] = {}
        self._on_news = self._tell  # made once, and not for each goal
        self._held = 0  # bytes of goals that are being decided upon
        self._told = Notifier()

    def limit_for(self, message: GoalRequest) -> str:
        """Return a sentence about the limit that forbids this request now; empty if none does."""
        limits = self._limits
        if len(self._open) >= limits.goals:
            return too_much(limits)
        if self._follows.get(message.goal_id, 0) < limits.follows:
            return ""
        return (
            f"too much at once: this connection follows goal {GoalID(message.goal_id)} already"
            f" {limits.follows} times, which is the limit"
        )

    def get(self, request: int) -> GoalSubscription | None:
        """Return the goal of a request, if there is one."""
        return self._open.get(request)

    def begin(self, message: GoalRequest) -> None:
        """Send or follow a goal for the client."""
        subscription = GoalSubscription(
            message.id, message.goal_id, message.credit, self._on_news, self._client.max_frame
        )
        self._open[message.id] = subscription
        self._follows[message.goal_id] = self._follows.get(message.goal_id, 0) + 1
        if type(message) is Follow:
            self.tasks.start_soon(self._follow, message, subscription)
        elif self._client.is_trusted:
            # No permission has to be waited for, so most goals need no task here.
            with self._answering(message):
                self._offer(message, subscription, self._client.find(message.action))
        else:
            self.tasks.start_soon(self._send_goal, message, subscription)

    def received(self, message: Received) -> None:
        """Note that the client has the end of a goal, or does not wait for it any longer."""
        goal = self._open.get(message.id)
        if goal is not None:
            goal.is_wanted = False
            if goal.told or goal.is_observed:  # an observer may stop at any time
                self._end(goal)

    def fail(self, request: int) -> None:
        """Forget a goal whose request was answered with an error."""
        if request in self._open:
            self._end(self._open[request])

    def release(self, *, left: bool) -> None:
        """Leave all goals: the connection has ended. `left` says that the client said goodbye."""
        for subscription in tuple(self._open.values()):
            if subscription.stream is not None:
                self._remove(subscription)
                self._give_up(subscription, left=left)
        self._told.notify()

    async def drain(self) -> None:
        """Wait until the client was told of every goal that has ended, or the link has ended."""
        while self._link.is_open and any(
            subscription.has_end_to_tell for subscription in self._open.values()
        ):
            await self._told.wait()

    async def _send_goal(self, message: SendGoal, subscription: GoalSubscription) -> None:
        with self._answering(message):
            endpoint = await self._client.endpoint(message.action, Permission.SEND)
            self._offer(message, subscription, endpoint)

    def _offer(self, message: SendGoal, subscription: GoalSubscription, endpoint: Endpoint) -> None:
        size = len(message.goal)
        if self._held + size > self._limits.memory:
            raise GoalRejected(f"too many bytes at once: the limit is {self._limits.memory}")
        goal_id, feedback = GoalID(message.goal_id), message.credit is not None
        ended = self._ended(goal_id, message.goal)
        if ended is not None:
            # The goal is sent again, because the answer was lost. Its server may have forgotten it
            # by now, and must not run it twice.
            ended.seek(0)
            self._begin_stream(subscription, endpoint, ended, own=True)
            return
        offered = endpoint.offer_goal(
            goal_id, message.goal, feedback=feedback, sender=self._client.sender
        )
        if isinstance(offered, GoalStream):
            self._begin_stream(subscription, endpoint, offered, own=True, goal=message.goal)
        else:
            self._held += size
            self.tasks.start_soon(self._await_answer, message, subscription, endpoint, offered)

    async def _await_answer(
        self,
        message: SendGoal,
        subscription: GoalSubscription,
        endpoint: Endpoint,
        offered: Awaitable[GoalStream],
    ) -> None:
        with self._answering(message):
            try:
                stream = await offered
            finally:
                self._held -= len(message.goal)
            self._begin_stream(subscription, endpoint, stream, own=True, goal=message.goal)

    async def _follow(self, message: Follow, subscription: GoalSubscription) -> None:
        with self._answering(message):
            goal_id = GoalID(message.goal_id)
            own = message.own and self._owners.is_own(goal_id, self._client.session)
            permission = Permission.SEND if own else Permission.OBSERVE
            endpoint = await self._client.endpoint(message.action, permission)
            stream: GoalStream | None
            try:
                stream = await endpoint.feedback(goal_id, after=message.after, own=own)
            except UnknownGoal:
                # Its server has forgotten the goal, but its client has not been told the end yet.
                stream = self._ended(goal_id) if own else None
                if stream is None:
                    raise
                if message.after is not None:
                    stream.seek(message.after)
            self._begin_stream(subscription, endpoint, stream, own=own)

    def _ended(self, goal_id: GoalID, goal: bytes | None = None) -> GoalStream | None:
        """Return the stream of this client's goal that has ended on an earlier connection."""
        stream = self._owners.ended(goal_id, self._client.session, goal)
        if stream is None or any(
            subscription.stream is stream for subscription in self._open.values()
        ):
            return None
        return stream

    def _begin_stream(
        self,
        subscription: GoalSubscription,
        endpoint: Endpoint,
        stream: GoalStream,
        *,
        own: bool,
        goal: bytes | None = None,
    ) -> None:
        own = own and self._owners.own(stream, self._client.session, goal)
        subscription.begin(endpoint, stream, own=own)
        if not (own or subscription.is_wanted):
            self._end(subscription)

    def _tell(self, subscription: GoalSubscription) -> None:
        self._ready[subscription] = None
        self._link.wake_writer()

    def next_frames(self) -> list[bytes]:
        """Return frames about goals: some of each in turn, as many as fill one write."""
        frames: list[bytes] = []
        size = 0
        while self._ready and size < CHUNK:
            subscription = next(iter(self._ready))
            del self._ready[subscription]
            more = subscription.next_frames()
            if more and not subscription.told:
                self._ready[subscription] = None  # behind the others
            frames += more
            size += sum(map(len, more))
            if subscription.told:
                self._told.notify()
                if not subscription.own:
                    self._end(subscription)
        return frames

    def _end(self, subscription: GoalSubscription) -> None:
        """Forget a goal whose end was told, or which has no end to tell."""
        self._remove(subscription)
        self._ready.pop(subscription, None)
        if subscription.stream is not None:
            subscription.leave()
            self._owners.end(subscription.stream)

    def _remove(self, subscription: GoalSubscription) -> None:
        """Count a subscription as no longer open."""
        del self._open[subscription.request]
        left = self._follows.pop(subscription.goal_id) - 1
        if left:
            self._follows[subscription.goal_id] = left

    def _give_up(self, subscription: GoalSubscription, *, left: bool) -> None:
        """Leave a goal to its owner's next connection: this one has ended."""
        assert subscription.stream is not None
        assert subscription.endpoint is not None
        subscription.leave()
        if subscription.own:
            self._owners.adopt(subscription.endpoint, subscription.stream, left=left)
        else:
            self._owners.end(subscription.stream)

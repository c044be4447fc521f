"""`SessionGoals`: the goals that one client sends and follows over one connection.

Theory of operation
-------------------

Most goals need no task here: `offer_goal` often has an answer at once, and what there is to tell is
fetched by the link, which asks `next_frames` when the line can take more. A goal whose stream has
news is *ready*, and the ready goals take turns. A write ends when it is large enough, or has taken
long enough, so that other connections have their turn. So a client with many goals or connections
does not keep others waiting: requests that concern many goals are answered one by one for each
client (`requests`), and all lines that have frames left to handle share one slice of each turn of
the event loop (`LineTurns` of the transports over sockets).

A goal that waits, for the answer of its endpoint or for a permission, counts with its bytes against
`Limits.memory`, and, together with those of other connections, against `Limits.total_memory`.

A goal may be sent again. If another client has sent it before, this one becomes an observer: it
needs the permission to observe before anything is told, and the executor does not wait for it. The
endpoint tells it by `GoalStream.own`; behind a gateway, which has one client for all of its
clients, `Owners` knows it. If a client follows a goal as its own, `Owners` knows it, or the
endpoint (`Endpoint.owner_of`), which may have kept the goal since before a restart.

A server that stops and keeps its goals says nothing about them: a stream or a request that ends
with `GoalKept` is forgotten here, and its client asks again on its next connection.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Coroutine
from time import perf_counter
from typing import Any, TypeAlias

from anyio import current_time, get_cancelled_exc_class
from anyio.abc import TaskGroup

from fibaction._runtime.notify import Notifier
from fibaction.border.abc import Endpoint, GoalRequest, GoalStream
from fibaction.border.byte_budgets import ByteBudget
from fibaction.border.event_loop import SLICE
from fibaction.wire.auth import Permission
from fibaction.wire.channel import CHUNK
from fibaction.wire.frames import UNCOUNTED
from fibaction.wire.link import Link
from fibaction.wire.messages import Follow, Received, SendGoal
from fibaction.wire.server.ownership import Owners
from fibaction.wire.server.session_client import SessionClient
from fibaction.wire.server.subscriptions import GoalSubscription, HeldGoals
from fibaction.wire.settings import Limits
from fibaction.words.errors import GoalRejected, RejectionCode
from fibaction.words.goals import GoalID
from fibaction.words.meta import size_of

GoalMessage: TypeAlias = SendGoal | Follow
"""A message that opens a goal's request."""
OnError: TypeAlias = Callable[[GoalMessage, BaseException], None]
"""Answers a message whose request has raised an error; raises a cancellation of the session."""
Waiting: TypeAlias = Coroutine[Any, Any, None]
"""The rest of the way to the answer of a request, which takes time."""


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
        memory: ByteBudget,
        link: Link,
        fail: OnError,
    ) -> None:
        """Let `memory` count the bytes of goals that wait, over all connections, and `fail` answer
        the messages whose requests have raised an error.
        """
        self.tasks: TaskGroup
        self._client = client
        self._owners = owners
        self._limits = limits
        self._memory = memory
        self._link = link
        self._fail = fail
        self._held = HeldGoals()
        self.open = self._held.calls
        """The goals, by their requests."""
        self._follows: dict[bytes, int] = {}  # the number of them for each goal
        self._ready: dict[GoalSubscription, None] = {}
        self._on_news = self._tell  # made once, and not for each goal
        self._undecided = 0  # bytes of goals that wait
        self._told = Notifier()

    def limit_for(self, message: GoalMessage) -> str:
        """Return a sentence about the limit that forbids this request now; empty if none does."""
        limits = self._limits
        if len(self.open) >= limits.goals:
            return too_much(limits)
        if self._follows.get(message.goal_id, 0) < limits.follows:
            return ""
        return (
            f"too much at once: this connection follows goal {GoalID(message.goal_id)} already"
            f" {limits.follows} times, which is the limit"
        )

    def begin(self, message: GoalMessage) -> None:
        """Send or follow a goal for the client."""
        client = self._client
        subscription = GoalSubscription(
            message,
            self._held,
            self._on_news,
            client.max_frame,
            takes_batches=client.takes_batches,
        )
        self.open[message.id] = subscription
        self._follows[message.goal_id] = self._follows.get(message.goal_id, 0) + 1
        if type(message) is Follow:
            self.tasks.start_soon(self._wait, message, 0, self._follow(message, subscription))
            return
        try:
            size = self._checked_size(message)
            timeout = message.timeout
            request = GoalRequest(
                GoalID(message.goal_id),
                message.goal,
                feedback=message.credit is not None,
                sender=client.sender,
                deadline=math.inf if timeout is None else current_time() + timeout,
                meta=message.meta,
                checked=message.checked,
            )
            waiting: Waiting | None
            if client.is_trusted:
                # No permission has to be waited for, so most goals need no task here.
                waiting = self._offer(request, subscription, client.find(message.action))
            else:
                waiting = self._send_goal(request, subscription)
        except (Exception, get_cancelled_exc_class()) as exc:
            self._fail(message, exc)
            return
        if waiting is not None:
            self._undecided += size
            self._memory.take(size)
            self.tasks.start_soon(self._wait, message, size, waiting)

    def received(self, message: Received) -> None:
        """Note that the client has the end of a goal, or does not wait for it any longer."""
        goal = self.open.get(message.id)
        if goal is not None:
            goal.is_wanted = False
            if goal.told or goal.is_observed:  # an observer may stop at any time
                self._end(goal)

    def fail(self, request: int) -> None:
        """Forget a goal whose request was answered with an error."""
        if request in self.open:
            self._end(self.open[request])

    def lose(self) -> None:
        """Leave all goals to the next connection of their client: this one ends."""
        self._held.is_lost = True
        self._told.notify()

    def release(self, *, left: bool) -> None:
        """Leave all goals: the connection has ended. `left` says that the client said goodbye."""
        self._owners.lose(self._held, left=left)
        self._told.notify()

    async def drain(self) -> None:
        """Wait until the client was told of every goal that has ended, or the link has ended."""
        for subscription in tuple(self.open.values()):
            while self._link.is_open and subscription.has_end_to_tell:
                await self._told.wait()

    # To send a goal

    def _checked_size(self, message: SendGoal) -> int:
        """Return the bytes of a goal, if it may wait.

        Raises:
            GoalRejected: Too many bytes are waiting.
            InvalidMessage: Its meta is too large.
        """
        size = len(message.goal) + (size_of(message.meta) if message.meta else 0)
        if self._undecided + size > self._limits.memory:
            raise GoalRejected(
                f"too many bytes at once: the limit is {self._limits.memory}",
                code=RejectionCode.INVALID if size > self._limits.memory else RejectionCode.BUSY,
            )
        # A little of each connection always passes: one client must not use up what all have.
        if self._undecided + size > UNCOUNTED and not self._memory.has_room(size):
            raise GoalRejected(
                f"too many bytes at once: the limit of all clients is {self._memory.limit}",
                code=RejectionCode.BUSY,
            )
        return size

    async def _wait(self, message: GoalMessage, size: int, waiting: Waiting) -> None:
        try:
            await waiting
        except (Exception, get_cancelled_exc_class()) as exc:
            self._fail(message, exc)
        finally:
            self._undecided -= size
            self._memory.give_back(size)

    async def _send_goal(self, request: GoalRequest, subscription: GoalSubscription) -> None:
        endpoint = await self._client.endpoint(subscription.action, Permission.SEND)
        waiting = self._offer(request, subscription, endpoint)
        if waiting is not None:
            await waiting

    def _offer(
        self, request: GoalRequest, subscription: GoalSubscription, endpoint: Endpoint
    ) -> Waiting | None:
        """Offer a goal to its endpoint; return what is left to wait for, if anything is."""
        ended = self._owners.ended(request.goal_id, request.sender.owner, request.goal)
        if ended is not None:
            # The goal is sent again, because the answer was lost. Its server may have forgotten it
            # by now, and must not run it twice.
            ended.seek(0)
            return self._begin_sent(request, subscription, endpoint, ended)
        offered = endpoint.offer_goal(request)
        if isinstance(offered, GoalStream):
            return self._begin_sent(request, subscription, endpoint, offered)
        return self._await_answer(request, subscription, endpoint, offered)

    async def _await_answer(
        self,
        request: GoalRequest,
        subscription: GoalSubscription,
        endpoint: Endpoint,
        offered: Coroutine[Any, Any, GoalStream],
    ) -> None:
        waiting = self._begin_sent(request, subscription, endpoint, await offered)
        if waiting is not None:
            await waiting

    def _begin_sent(
        self,
        request: GoalRequest,
        subscription: GoalSubscription,
        endpoint: Endpoint,
        stream: GoalStream,
    ) -> Waiting | None:
        """Begin to tell a goal that was sent; return the wait for a permission, if one is needed.

        If another client has sent the goal before, this one observes it.
        """
        owner = request.sender.owner
        own = stream.own and self._owners.own(subscription, stream, owner, request.goal)
        if not own:
            stream.hold(False)
        elif self._link.holds_briefly:
            stream.hold_briefly()
        if not (own or self._client.is_trusted):
            return self._observe(subscription, endpoint, stream)
        self._begin(subscription, endpoint, stream, own=own)
        return None

    async def _observe(
        self, subscription: GoalSubscription, endpoint: Endpoint, stream: GoalStream
    ) -> None:
        try:
            await self._client.endpoint(subscription.action, Permission.OBSERVE)
        except BaseException:
            stream.close()
            raise
        self._begin(subscription, endpoint, stream, own=False)

    # To follow a goal

    async def _follow(self, message: Follow, subscription: GoalSubscription) -> None:
        goal_id, owner = GoalID(message.goal_id), self._client.sender.owner
        own = message.own and (
            self._owners.is_own(goal_id, owner) or self._client.is_owner(message.action, goal_id)
        )
        permission = Permission.SEND if own else Permission.OBSERVE
        endpoint = await self._client.endpoint(message.action, permission)
        stream = await self._owners.follow(message, endpoint, owner if own else b"")
        own = own and self._owners.own(subscription, stream, owner)
        self._begin(subscription, endpoint, stream, own=own)

    # To tell

    def _begin(
        self,
        subscription: GoalSubscription,
        endpoint: Endpoint,
        stream: GoalStream,
        *,
        own: bool,
    ) -> None:
        subscription.begin(endpoint, stream, own=own)
        if not (own or subscription.is_wanted):
            self._end(subscription)

    def _tell(self, subscription: GoalSubscription) -> None:
        if self._link.is_open:
            self._ready[subscription] = None
            self._link.wake_writer()

    def next_frames(self) -> list[bytes]:
        """Return frames about goals: some of each in turn, as many as fill one write."""
        frames: list[bytes] = []
        size = 0
        slice_end = perf_counter() + SLICE
        while self._ready and size < CHUNK:
            # Without any frame, the line would take it that there is nothing more to tell.
            if frames and perf_counter() >= slice_end:
                break
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
        del self.open[subscription.request]
        left = self._follows.pop(subscription.goal_id) - 1
        if left:
            self._follows[subscription.goal_id] = left
        self._ready.pop(subscription, None)
        if subscription.stream is not None:
            if not subscription.told:
                subscription.leave()
            self._owners.end(subscription)

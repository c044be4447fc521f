"""The server's half: takes one client's requests, calls the endpoints, and sends what they say.

It decides nothing about goals. `AccessPolicy` says what a client may do.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Awaitable, Callable, Generator, Mapping
from contextlib import contextmanager

from anyio import current_effective_deadline, get_cancelled_exc_class, sleep
from anyio.abc import TaskGroup

from fibaction._notify import Notifier
from fibaction._tasks import Background
from fibaction.abc import Endpoint, GoalStream
from fibaction.exceptions import (
    ActionError,
    AuthenticationFailed,
    ConnectionLost,
    GoalRejected,
    LimitReached,
    ProtocolError,
    ServerNotFound,
    UnknownGoal,
)
from fibaction.goals import UNKNOWN_SENDER, GoalID, Sender
from fibaction.server.goal_record import digest_of
from fibaction.wire.auth import Peer, Permission
from fibaction.wire.channel import CHUNK
from fibaction.wire.errors import failed, failure_of, fitting, goodbye_of
from fibaction.wire.framing import MAX_FRAME
from fibaction.wire.link import Link
from fibaction.wire.messages import (
    VERSION,
    Close,
    Credit,
    Failed,
    Follow,
    FromClient,
    Goodbye,
    Hello,
    Ping,
    Received,
    Rejected,
    SendGoal,
    Welcome,
    Why,
    decode_from_client,
    encode,
)
from fibaction.wire.ownership import Owners
from fibaction.wire.requests import Answer, Request, RequestHandlers
from fibaction.wire.settings import ServerSettings
from fibaction.wire.subscriptions import (
    GoalSubscription,
    RequestSubscription,
    Subscription,
)

logger = logging.getLogger("fibaction.wire")


class Session:
    """One client's connection."""

    def __init__(
        self,
        link: Link,
        endpoints: Mapping[str, Endpoint],
        terms: ServerSettings,
        orphans: Owners,
        clients_of: Callable[[str], list[str]],
        supersede: Callable[[bytes], None],
    ) -> None:
        """`clients_of` says who uses an action, this client and all others; `supersede` ends the
        connections before this one of the client whose session that is.
        """
        self.actions: set[str] = set()
        """The actions that the client has named."""
        self._supersede = supersede
        self._link = link
        self._endpoints = endpoints
        self._terms = terms
        self._orphans = orphans
        self._peer: Peer | None = None
        self.session = b""
        """What the client calls itself on each of its connections, one after another: a secret."""
        self._sender = UNKNOWN_SENDER
        self._max_frame = MAX_FRAME
        self._left = False
        self._waiting: dict[int, RequestSubscription] = {}
        self._goals: dict[int, GoalSubscription] = {}
        self._ready: dict[GoalSubscription, None] = {}
        self._on_news = self._tell  # made once, and not for each goal
        self._held = 0
        self._progress = Notifier()
        self._tasks: TaskGroup
        self._answers = RequestHandlers(endpoints, self._endpoint, clients_of, self._say)

    async def run(self) -> ActionError:
        """Serve the client until the connection ends, and say why it did."""
        try:
            async with Background() as self._tasks:
                self._tasks.start_soon(self._expect_hello)
                error = await self._link.run(self._handle, self._collect)
                if isinstance(error, ProtocolError | AuthenticationFailed | LimitReached):
                    await self._link.say_last(encode(goodbye_of(error)))
                return error
        finally:
            self._release()
            self._progress.notify()

    async def drain(self) -> None:
        """Wait until the client has been told of every goal that has ended, and say goodbye."""
        while self._link.is_open and any(
            subscription.has_end_to_tell for subscription in self._goals.values()
        ):
            await self._progress.wait()
        self._link.post(encode(Goodbye("the server is closing the connection")))
        await self._link.flush()

    def end(self) -> None:
        """The client has a newer connection: what was under way on this one goes on there."""
        self._release()
        self._link.end(ConnectionLost("its client has a newer connection"))

    def _release(self) -> None:
        for subscription in tuple(self._goals.values()):
            if subscription.stream is not None:
                del self._goals[subscription.request]
                self._give_up(subscription)

    async def _expect_hello(self) -> None:
        handshake = self._terms.limits.handshake
        await sleep(handshake)
        if self._peer is None:
            # The line may have been held up, so the client may try again.
            self._link.end(LimitReached(f"it has not said hello within {handshake:g} s"))

    # What arrives

    def _handle(self, frame: bytes) -> None:
        message = decode_from_client(frame)
        # Where most messages pass: for a class of msgspec's, `isinstance` takes ten times as long.
        if self._peer is None:
            self._welcome(message)
        elif type(message) is SendGoal or type(message) is Follow:
            self._begin_goal(message)
        elif type(message) is Received:
            # Of what it only observes, it may want nothing more at any time.
            goal = self._goals.get(message.id)
            if goal is not None:
                goal.is_wanted = False
                if goal.told or goal.is_observed:
                    self._end(goal)
        elif isinstance(message, Credit):
            if (subscription := self._subscription(message.id)) is not None:
                subscription.add(message.count)
        elif isinstance(message, Close):
            if (subscription := self._subscription(message.id)) is not None:
                subscription.close()
        elif isinstance(message, Goodbye):
            self._left = True
            # It goes into a log, so it is one line of it, and not of any length.
            reason = "".join(c if c.isprintable() else " " for c in message.reason[:200])
            self._link.end(ConnectionLost(f"{self._link.peer} left: {reason}"))
        elif isinstance(message, Hello):
            raise ProtocolError("it said hello twice")
        elif not isinstance(message, Ping):
            self._begin(message)

    def _welcome(self, message: FromClient) -> None:
        if not isinstance(message, Hello):
            raise ProtocolError(f"its first message was a {type(message).__name__}, not a Hello")
        if message.version != VERSION:
            raise ProtocolError(
                f"it speaks version {message.version} of the protocol, and this is {VERSION}"
            )
        self._peer = self._terms.access.admit(self._link.peer, message.token)
        if self._peer is None:
            # For the log, and for the client: so it says whose token it is.
            raise AuthenticationFailed(
                "the server refused the client's token"
                if message.token
                else "the server wants a token, and the client gave none"
            )
        if message.session:
            # Or what was under way on the one before could come late, and run a goal once more.
            self._supersede(message.session)
        self.session = message.session
        owner = digest_of(message.session) if message.session else b""
        self._sender = Sender(self.client, owner)
        self._max_frame = message.max_frame
        self._link.peer_heartbeat = message.heartbeat
        welcome = Welcome(VERSION, self._terms.heartbeat, self._terms.limits.frame)
        self._link.post(encode(welcome))

    def _subscription(self, request: int) -> Subscription | None:
        return self._goals.get(request) or self._waiting.get(request)

    def _admits(self, message: SendGoal | Follow | Request, *, has_room: bool) -> bool:
        if self._subscription(message.id) is not None:
            raise ProtocolError(f"it used the ID {message.id} twice")
        if not has_room:
            limits = self._terms.limits
            text = (
                f"too much at once: the limits of a connection are {limits.goals} goals"
                f" and {limits.requests} other requests"
            )
            refused: Rejected | Failed = Failed(message.id, Why.LIMIT, text)
            if isinstance(message, SendGoal):
                refused = Rejected(message.id, text)
            self._link.post(encode(refused))
        return has_room

    # Goals

    def _begin_goal(self, message: SendGoal | Follow) -> None:
        if not self._admits(message, has_room=len(self._goals) < self._terms.limits.goals):
            return
        subscription = GoalSubscription(message.id, message.credit, self._on_news, self._max_frame)
        self._goals[message.id] = subscription
        if type(message) is Follow:
            self._tasks.start_soon(self._follow, message, subscription)
        elif self._terms.access.is_open:
            # Nobody has to be asked, so most goals need no task here.
            try:
                self._offer(message, subscription, self._find(message.action))
            except Exception as exc:
                self._refuse(message, exc)
        else:
            self._tasks.start_soon(self._send_goal, message, subscription)

    async def _send_goal(self, message: SendGoal, subscription: GoalSubscription) -> None:
        with self._answering(message):
            self._offer(
                message, subscription, await self._endpoint(message.action, Permission.SEND)
            )

    def _offer(self, message: SendGoal, subscription: GoalSubscription, endpoint: Endpoint) -> None:
        size = len(message.goal)
        if self._held + size > self._terms.limits.memory:
            raise GoalRejected(f"too many bytes at once: the limit is {self._terms.limits.memory}")
        goal_id, feedback = GoalID(message.goal_id), message.credit is not None
        ended = self._ended(goal_id, message.goal)
        if ended is not None:
            # It is sent again, because the answer was lost. Its server may have forgotten it by
            # now, and must not run it twice.
            ended.seek(0)
            self._begin_stream(subscription, endpoint, ended, own=True)
            return
        offered = endpoint.offer_goal(goal_id, message.goal, feedback=feedback, sender=self._sender)
        if isinstance(offered, GoalStream):
            self._begin_stream(subscription, endpoint, offered, own=True, goal=message.goal)
        else:
            self._held += size
            self._tasks.start_soon(self._await_answer, message, subscription, endpoint, offered)

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
            own = message.own and self._orphans.is_own(goal_id, self.session)
            endpoint = await self._endpoint(
                message.action, Permission.SEND if own else Permission.OBSERVE
            )
            stream: GoalStream | None
            try:
                stream = await endpoint.feedback(goal_id, after=message.after, own=own)
            except UnknownGoal:
                # Its server has forgotten it, but its client has not yet heard the end.
                stream = self._ended(goal_id) if own else None
                if stream is None:
                    raise
                if message.after is not None:
                    stream.seek(message.after)
            self._begin_stream(subscription, endpoint, stream, own=own)

    def _ended(self, goal_id: GoalID, goal: bytes | None = None) -> GoalStream | None:
        """The stream of this client's goal that has ended on a connection before this one."""
        stream = self._orphans.ended(goal_id, self.session, goal)
        if stream is None or any(
            subscription.stream is stream for subscription in self._goals.values()
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
        own = own and self._orphans.own(stream, self.session, goal)
        subscription.begin(endpoint, stream, own=own)
        if not (own or subscription.is_wanted):
            self._end(subscription)

    def _tell(self, subscription: GoalSubscription) -> None:
        self._ready[subscription] = None
        self._link.wake_writer()

    def _collect(self) -> list[bytes]:
        """What there is to tell of goals: some of each in turn, as much as fills one write."""
        frames: list[bytes] = []
        size = 0
        while self._ready and size < CHUNK:
            subscription = next(iter(self._ready))
            del self._ready[subscription]
            more = subscription.take()
            if more and not subscription.told:
                self._ready[subscription] = None  # behind the others
            frames += more
            size += sum(map(len, more))
            if subscription.told:
                self._progress.notify()
                if not subscription.own:
                    self._end(subscription)
        return frames

    def _end(self, subscription: GoalSubscription) -> None:
        """The client has heard the end of a goal, or there is nothing to hear."""
        del self._goals[subscription.request]
        self._ready.pop(subscription, None)
        if subscription.stream is not None:
            subscription.leave()
            self._orphans.end(subscription.stream)

    def _give_up(self, subscription: GoalSubscription) -> None:
        """The connection has ended, and with it what the client could be told."""
        assert subscription.stream is not None
        assert subscription.endpoint is not None
        subscription.leave()
        if subscription.own:
            self._orphans.adopt(subscription.endpoint, subscription.stream, left=self._left)
        else:
            self._orphans.end(subscription.stream)

    # Other requests

    def _begin(self, message: Request) -> None:
        if self._admits(message, has_room=len(self._waiting) < self._terms.limits.requests):
            subscription = RequestSubscription(message.id, getattr(message, "credit", 0))
            self._waiting[message.id] = subscription
            self._tasks.start_soon(self._answer, message, subscription)

    async def _answer(self, message: Request, subscription: RequestSubscription) -> None:
        try:
            with self._answering(message):
                await self._answers.give(message, subscription)
        finally:
            del self._waiting[message.id]

    @contextmanager
    def _answering(self, message: SendGoal | Follow | Request) -> Generator[None, None, None]:
        """Of what a task does for the client, whatever goes wrong is an answer, too."""
        try:
            yield
        except (Exception, get_cancelled_exc_class()) as exc:
            # On asyncio, who awaits what somebody has canceled raises that, too. Only if a scope is
            # canceled, the session has ended, and there is nobody left to be told.
            if not isinstance(exc, Exception) and current_effective_deadline() == -math.inf:
                raise
            self._refuse(message, exc)

    def _refuse(self, message: SendGoal | Follow | Request, exc: BaseException) -> None:
        is_goal = isinstance(message, SendGoal | Follow)
        if not isinstance(exc, ActionError) or (isinstance(exc, GoalRejected) and not is_goal):
            # A bug of an endpoint or a callback. It concerns this client only.
            what = type(message).__name__
            logger.error("%s: its %s failed", self._link.peer, what, exc_info=exc)
            exc = failure_of(exc)
        if message.id in self._goals:
            self._end(self._goals[message.id])
        if self._link.is_open:
            self._link.post(failed(message.id, exc, self._max_frame))

    async def _endpoint(self, action: str, verb: Permission) -> Endpoint:
        assert self._peer is not None
        if not await self._terms.access.permits(self._peer, action, verb):
            raise AuthenticationFailed(f"this client may not {verb.value} at the action {action!r}")
        return self._find(action)

    @property
    def client(self) -> str:
        """The client as people know it: where it is, and whom its token belongs to."""
        name = self._peer.name if self._peer is not None else ""
        return f"{name} at {self._link.peer}" if name else self._link.peer

    def _find(self, action: str) -> Endpoint:
        try:
            endpoint = self._endpoints[action]
        except KeyError:
            known = ", ".join(map(repr, sorted(self._endpoints))) or "nothing"
            raise ServerNotFound(
                f"nobody serves the action {action!r} here: there is {known}"
            ) from None
        self.actions.add(action)
        return endpoint

    async def _say(self, answer: Answer) -> None:
        await self._link.send(fitting(answer.id, encode(answer), self._max_frame))

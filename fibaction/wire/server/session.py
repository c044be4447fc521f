"""`Session`: one client's connection at the server.

Theory of operation
-------------------

A `WireServer` makes a `Session` for each line. It takes the client's requests, calls endpoints, and
sends what they say. It decides nothing about goals: the endpoint does that, and what the client may
do is decided by the `AccessPolicy`. Its parts:

- `SessionClient` is the client: unknown until its `Hello`, then with a name and permissions.
- `SessionGoals` has the goals that the client sends and follows. They are told by the source of the
  `Link`, without tasks.
- `RequestHandlers` has all other requests. A task works on each, and one on all for the actions.
- `Owners` has the goals of all clients of the server, beyond the end of a connection. It is shared
  by all sessions.

A session goes through these steps. `run` starts the link; the `WireServer` ends the session unless
the client says hello in time. `_handle` gets each frame; it must not wait, so what takes time is a
task, or a subscription with credit. Each request has an ID that the client has not used on this
connection before, and gets its answer, or an error: `_fail` turns whatever goes wrong into one, by
the table in `errors`. A bug of an endpoint is an error for its client, and does not end the
session.

A client has a *session*: a secret that it sends with each `Hello`. A new connection of the same
session ends the one before, and takes over the goals that were open on it.

When the connection ends, for whatever reason, its goals are released to `Owners`, which keeps the
streams of the client's own goals for a while, so that no feedback is lost if it comes back. Then
`run` returns the error, which the `WireServer` logs. An error that the client can mend, such as a
rejected token, is told to it as the last message.

When the server closes, `drain` waits until the ends of goals are told, and says goodbye.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping

from anyio import current_effective_deadline, get_cancelled_exc_class
from anyio.abc import TaskGroup

from fibaction._runtime import RELEASE
from fibaction._runtime.log import clean_logger
from fibaction._runtime.text import excerpt
from fibaction.border.abc import Endpoint
from fibaction.border.byte_budgets import ByteBudget
from fibaction.wire.errors import failed, failure_of, fitting, goodbye_of
from fibaction.wire.frames import FIRST_FRAME
from fibaction.wire.link import Link
from fibaction.wire.messages import (
    LONGEST_HEARTBEAT,
    NEWEST_FROM_CLIENT,
    VERSION,
    Close,
    Credit,
    Failed,
    Follow,
    Goodbye,
    Hello,
    ListActions,
    Ping,
    Received,
    Rejected,
    SendGoal,
    Welcome,
    Why,
    decode_from_client,
    encode,
)
from fibaction.wire.server.ownership import Owners
from fibaction.wire.server.requests import Answer, Request, RequestHandlers
from fibaction.wire.server.session_client import SessionClient
from fibaction.wire.server.session_goals import GoalMessage, SessionGoals, too_much
from fibaction.wire.server.subscriptions import RequestSubscription, WireSubscription
from fibaction.wire.settings import WireSettings
from fibaction.words.errors import (
    ActionError,
    AuthenticationFailed,
    ConnectionLost,
    GoalKept,
    GoalRejected,
    LimitReached,
    ProtocolError,
    RejectionCode,
)

LONGEST_NAME = 1000
"""Characters of the name of an action, at most: a request may wait, with its name."""

logger = clean_logger("fibaction.wire")


class Session:
    """One client's connection."""

    def __init__(
        self,
        link: Link,
        endpoints: Mapping[str, Endpoint],
        settings: WireSettings,
        owners: Owners,
        memory: ByteBudget,
        clients_of: Callable[[str], list[str]],
        entered: Callable[[Session], None],
    ) -> None:
        """Let `clients_of` return the names of all clients that use an action, and call `entered`
        when the client is let in, which ends its earlier connection.
        """
        self.client = SessionClient(link.peer, endpoints, settings)
        self._link = link
        self._settings = settings
        self._entered = entered
        self._left = False
        self._is_ended = False
        self._goals = SessionGoals(self.client, owners, settings.limits, memory, link, self._fail)
        self._waiting: dict[int, RequestSubscription] = {}
        self._handlers = RequestHandlers(
            endpoints, self.client.endpoint, clients_of, self._say, self.client.change_of
        )
        self._listings: deque[tuple[ListActions, RequestSubscription]] = deque()
        self._tasks: TaskGroup

    async def run(self) -> ActionError:
        """Serve the client until the connection ends; return the error that ended it."""
        try:
            error = await self._link.run(self._handle, self._goals.next_frames, self._start)
            if self._is_ended or isinstance(
                error, ProtocolError | AuthenticationFailed | LimitReached
            ):
                await self._link.say_last(encode(goodbye_of(error)))
            return error
        finally:
            self._goals.release(left=self._left)

    def _start(self, tasks: TaskGroup) -> None:
        self._tasks = self._goals.tasks = tasks

    async def drain(self) -> None:
        """Wait until the client was told of every goal that has ended, and say goodbye."""
        await self._goals.drain()
        self._link.post(encode(Goodbye("the server is closing the connection")))
        await self._link.flush()

    def end(self, error: ActionError) -> None:
        """End the connection, and tell the client why; it may follow its goals on another one."""
        self._is_ended = True
        self._goals.lose()
        self._link.end(error)

    # Messages that arrive

    def _handle(self, frame: bytes) -> None:
        if not self.client.is_known:
            self._welcome(frame)
            return
        message = decode_from_client(frame)
        # Most messages pass here: for a class of msgspec's, `isinstance` takes ten times as long.
        if type(message) is SendGoal or type(message) is Follow:
            if self._admits(message, self._goals.limit_for(message)):
                self._goals.begin(message)
        elif type(message) is Received:
            self._goals.received(message)
        elif isinstance(message, Credit):
            if (subscription := self._subscription(message.id)) is not None:
                subscription.add(message.count)
        elif isinstance(message, Close):
            if (subscription := self._subscription(message.id)) is not None:
                subscription.close()
        elif isinstance(message, Goodbye):
            self._left = True
            self._link.end(ConnectionLost(f"{self._link.peer} left: {excerpt(message.reason)}"))
        elif isinstance(message, Hello):
            raise ProtocolError("it said hello twice")
        elif not isinstance(message, Ping):
            self._begin(message)

    def _welcome(self, frame: bytes) -> None:
        if len(frame) > FIRST_FRAME:  # of a line that has frames of its own
            raise ProtocolError(
                f"its first message has {len(frame)} bytes, but at most {FIRST_FRAME} are allowed"
            )
        hello = self.client.greet(decode_from_client(frame))
        # Otherwise a request on an earlier connection could come late, and run a goal again.
        self._entered(self)
        limits = self._settings.limits
        longest = min(limits.heartbeat, LONGEST_HEARTBEAT)
        self._link.heartbeat.agree(min(hello.heartbeat, longest))
        welcome = Welcome(
            VERSION,
            self._settings.heartbeat,
            limits.frame,
            longest,
            NEWEST_FROM_CLIENT,
            RELEASE,
        )
        self._link.post(encode(welcome))

    def _subscription(self, request: int) -> WireSubscription | None:
        return self._goals.open.get(request) or self._waiting.get(request)

    def _admits(self, message: GoalMessage | Request, limit: str) -> bool:
        """Reject the request if a limit, told as a sentence, forbids it."""
        if self._subscription(message.id) is not None:
            raise ProtocolError(f"it used the ID {message.id} twice")
        code = RejectionCode.BUSY
        if not limit and len(getattr(message, "action", "")) > LONGEST_NAME:
            code = RejectionCode.INVALID
            limit = f"the name of an action has at most {LONGEST_NAME} characters"
        if limit:
            answer: Rejected | Failed = Failed(message.id, Why.LIMIT, limit)
            if isinstance(message, SendGoal):
                answer = Rejected(message.id, limit, code)
            self._link.post(encode(answer))
        return not limit

    # Requests beside goals

    def _begin(self, message: Request) -> None:
        limits = self._settings.limits
        is_full = len(self._waiting) >= limits.requests
        limit = too_much(limits) if is_full else self._handlers.limit_for(message)
        if self._admits(message, limit):
            subscription = RequestSubscription(message.id, getattr(message, "credit", 0))
            self._waiting[message.id] = subscription
            self._handlers.begin(message, subscription)
            if type(message) is ListActions:
                self._listings.append((message, subscription))
                if len(self._listings) == 1:
                    self._tasks.start_soon(self._answer_listings)
            else:
                self._tasks.start_soon(self._answer, message, subscription)

    async def _answer_listings(self) -> None:
        """Answer the requests for the actions one after the other, as they come.

        One that waits because the client reads nothing is a message and not a task, of some forty
        objects: thousands of these would make a garbage collection longer than a turn may take.
        """
        while self._listings:
            await self._answer(*self._listings[0])
            self._listings.popleft()

    async def _answer(self, message: Request, subscription: RequestSubscription) -> None:
        try:
            await self._handlers.handle(message, subscription)
        except (Exception, get_cancelled_exc_class()) as exc:
            self._fail(message, exc)
        finally:
            del self._waiting[message.id]

    async def _say(self, answer: Answer) -> None:
        await self._link.send(lambda: fitting(answer.id, encode(answer), self.client.max_frame))

    # Errors

    def _fail(self, message: GoalMessage | Request, exc: BaseException) -> None:
        """Answer a request that has raised an exception."""
        # On asyncio, awaiting a task that was canceled elsewhere raises that, too. Only if a scope
        # is canceled, the session has ended, and the client cannot be told.
        if not isinstance(exc, Exception) and current_effective_deadline() == -math.inf:
            raise exc
        is_goal = isinstance(message, SendGoal | Follow)
        if not isinstance(exc, ActionError) or (isinstance(exc, GoalRejected) and not is_goal):
            # A bug of an endpoint or a callback. It concerns this client only.
            what = type(message).__name__
            logger.error("%s: its %s failed", self._link.peer, what, exc_info=exc)
            exc = failure_of(exc)
        self._goals.fail(message.id)
        # Without an answer, the client asks again on its next connection.
        if self._link.is_open and not isinstance(exc, GoalKept):
            self._link.post(failed(message.id, exc, self.client.max_frame))

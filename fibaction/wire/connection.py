"""The client's half: endpoints whose server is at the other end of a connection.

It keeps the connection, opens it anew when it is lost, and asks again for what was under way.
"""

from __future__ import annotations

import itertools
import logging
import random
import secrets
from collections import deque
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any
from weakref import WeakValueDictionary

import anyio
from anyio import CancelScope, create_task_group, current_time
from anyio.abc import TaskGroup

from fibaction._notify import Notifier
from fibaction._tasks import Background
from fibaction.abc import Connection, Endpoint
from fibaction.action import Action, ActionInfo
from fibaction.exceptions import (
    ActionError,
    AuthenticationFailed,
    ConnectionLost,
    InvalidMessage,
    InvalidURL,
    LimitReached,
    ProtocolError,
    ServerNotFound,
)
from fibaction.goals import (
    UNKNOWN_SENDER,
    ActionPeers,
    CancelAnswer,
    CancelCode,
    GoalID,
    GoalInfo,
    Sender,
)
from fibaction.wire.calls import Call, PendingRequest, RemoteGoal, RemoteStatuses
from fibaction.wire.channel import CHUNK, Line
from fibaction.wire.errors import copied, error_of_goodbye
from fibaction.wire.framing import MAX_FRAME
from fibaction.wire.link import Link, naming
from fibaction.wire.messages import (
    LARGEST,
    VERSION,
    Actions,
    AskPeers,
    AwaitServer,
    CancelAnswered,
    CancelGoals,
    Done,
    Ended,
    Follow,
    FromClient,
    FromServer,
    Goodbye,
    Hello,
    ListActions,
    Peers,
    Ping,
    Received,
    SendGoal,
    Welcome,
    Why,
    decode_from_server,
    encode,
)
from fibaction.wire.settings import ClientSettings

logger = logging.getLogger("fibaction.wire")

FIRST_PAUSE, LONGEST_PAUSE = 0.02, 2.0
"""Seconds between attempts to connect: short enough at first for a line that only flickered, and
rare enough later for a server that is away for hours."""
DIAL_TIMEOUT = 5.0
"""Seconds that one attempt to connect may take."""
LEAVE_TIMEOUT = 1.0
"""Seconds that leaving a connection waits for what was said last to be written."""

Dial = Callable[[], Awaitable[Line]]
"""Opens a line; raises `TransportError`."""


class RemoteConnection(Connection):
    """A connection to a server, by whatever `dial` opens, kept open while its block lasts."""

    def __init__(self, dial: Dial, where: str, keeping: ClientSettings) -> None:
        self._dial = dial
        self._where = where
        self._keeping = keeping
        self._link: Link | None = None
        self._ready = False
        self._absent: ActionError | None = None
        self._final = False
        self._max_frame = MAX_FRAME
        self._session = secrets.token_bytes(16)
        self._patience: CancelScope | None = None  # while calls wait for a lost connection
        self._failure: ActionError  # of the attempt before this one
        self._calls: dict[int, Call] = {}
        # Those of whoever only looks on, for as long as somebody does: one goal may have many.
        self._observed: WeakValueDictionary[int, RemoteGoal] = WeakValueDictionary()
        self._unopened: deque[Call] = deque()  # on this connection; by turns, for they may be large
        self._ids = itertools.count(1)
        # Of two, one can be let go of for the next; behind one, unread, the end would never come.
        self._window = max(keeping.window, 2)
        self._changed = Notifier()
        self.changes = 0
        """How often a connection was opened, or given up: see `changed`."""

    # For users

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        return RemoteEndpoint(self, action.info if isinstance(action, Action) else action)

    async def actions(self) -> list[ActionInfo]:
        answer = await self.ask(lambda call_id: ListActions(call_id), Actions)
        return list(answer.actions)

    async def peers(self, action: str) -> ActionPeers:
        answer: Peers = await self.ask(lambda call_id: AskPeers(call_id, action), Peers)
        return ActionPeers((self._where,), tuple(answer.clients))

    # For endpoints

    async def ask(self, request: Callable[[int], FromClient], kind: type[Any]) -> Any:
        """Ask a question, on this connection or the next, and give its answer.

        Raises:
            ActionError: What the server says instead, or why it cannot be asked.
        """
        call_id = next(self._ids)
        question = PendingRequest(call_id, request(call_id))
        await self._open(question)
        return question.answer(kind)

    async def follow(
        self, goal_id: GoalID, request: Callable[[int, int], SendGoal | Follow]
    ) -> RemoteGoal:
        """Send or follow a goal; `request` gets the ID of the call, and the credit.

        Raises:
            ActionError: As for `ask`.
        """
        opening = request(next(self._ids), self._window)
        goal = RemoteGoal(goal_id, opening, self._window, self._post)
        await self._open(goal)
        if not goal.is_own and self._calls.pop(goal.id, None) is not None:
            self._observed[goal.id] = goal
        return goal

    async def watch(self, action: str) -> RemoteStatuses:
        """Follow the statuses of an action.

        Raises:
            ActionError: As for `ask`.
        """
        statuses = RemoteStatuses(next(self._ids), action, self._keeping.window, self._post)
        await self._open(statuses)
        return statuses

    @property
    def is_open(self) -> bool:
        """True if the server has let this client in, and the connection has not ended."""
        return self._ready

    async def changed(self, since: int) -> None:
        """Wait until there is another connection than when `changes` was that.

        Raises:
            TransportError: There will be none.
        """
        while self.changes == since and not self._final:
            await self._changed.wait()
        if self._final and self._absent is not None:
            raise copied(self._absent)

    async def _open(self, call: Call) -> None:
        """Open a call, and wait until the server has granted it, or give it up."""
        if self._absent is not None:
            raise copied(self._absent)
        self._calls[call.id] = call
        if self._link is not None and self._ready:
            self._unopened.append(call)
            # Several calls, made in the same turn of the event loop, go together.
            self._link.wake_writer(at_once=len(self._calls) == 1)
        try:
            await call.answered()
        except BaseException:
            if self._calls.pop(call.id, None) is not None:
                self._post(call.giving_up())
            raise

    def _openings(self) -> list[bytes]:
        """What opens the calls that are not open on this connection, as much as fills one write."""
        frames: list[bytes] = []
        size = 0
        while self._unopened and size < CHUNK:
            call = self._unopened.popleft()
            if call is not (self._calls.get(call.id) or self._observed.get(call.id)):
                continue  # given up since
            if call.is_over:
                self._drop(call)
                continue
            try:
                frame = encode(call.opening())
            except (TypeError, ValueError, OverflowError) as exc:
                # The fault of whoever calls: no other call may suffer.
                self._refuse(call, f"the message cannot be sent: {exc}")
                continue
            if len(frame) <= self._max_frame:
                frames.append(frame)
                size += len(frame)
            else:
                limit = f"{self._max_frame} are the server's limit"
                self._refuse(call, f"the message has {len(frame)} bytes, and {limit}")
        return frames

    def _refuse(self, call: Call, text: str) -> None:
        self._drop(call)
        call.fail(InvalidMessage(text))

    def _drop(self, call: Call) -> None:
        if self._calls.pop(call.id, None) is None:
            self._observed.pop(call.id, None)

    def _post(self, message: FromClient) -> None:
        if self._link is not None and self._ready:
            self._link.post(encode(message))

    # The connection

    async def first_attempt(self) -> None:
        """Wait until the first attempt to connect has come to something.

        Raises:
            TransportError: It failed, and there will be no other.
        """
        while not self._ready and self._absent is None:
            await self._changed.wait()
        if self._final and self._absent is not None:
            raise copied(self._absent)

    async def run(self) -> None:
        """Connect, and connect again, until it is of no use."""
        async with create_task_group() as tasks:
            await self._keep_connecting(tasks)
            tasks.cancel_scope.cancel()

    async def _keep_connecting(self, tasks: TaskGroup) -> None:
        pause = FIRST_PAUSE
        while True:
            error = self._failure = await self._attempt()
            if self._ready:
                self._ready, pause = False, FIRST_PAUSE
                self._patience = CancelScope()
                ends = current_time() + self._keeping.reconnect_timeout
                tasks.start_soon(self._lose_patience, self._patience, ends)
                logger.info("%s", naming(self._where, error))
            if _is_final(error) or not self._keeping.reconnect:
                self._final = True  # and if the connection was left meanwhile, it is so already
            if self._final or self._patience is None:
                self._give_up(error)
            if self._final:
                return
            await anyio.sleep(pause * random.uniform(0.5, 1))  # no secret
            pause = min(2 * pause, LONGEST_PAUSE)

    async def _lose_patience(self, patience: CancelScope, ends: float) -> None:
        # Beside the attempts to connect, which may take longer than anybody is to wait.
        with patience:
            await anyio.sleep_until(ends)
            if self._patience is patience:  # else there is a connection, since this moment
                self._give_up(self._failure)

    def _end_patience(self) -> None:
        if self._patience is not None:
            self._patience.cancel()
            self._patience = None

    async def leave(self) -> None:
        """Say goodbye, and let nobody wait any longer."""
        try:
            with anyio.move_on_after(LEAVE_TIMEOUT, shield=True):
                if self._link is not None:
                    self._link.post(encode(Goodbye("the client has what it wanted")))
                    await self._link.flush()
        finally:  # asyncio can cancel the task itself, which no scope shields
            self._final = True
            self._give_up(ConnectionLost(f"the connection to {self._where} was closed here"))

    async def _attempt(self) -> ActionError:
        try:
            with anyio.fail_after(DIAL_TIMEOUT):
                line = await self._dial()
        except TimeoutError:
            return ServerNotFound(f"{self._where} did not answer within {DIAL_TIMEOUT:g} s")
        except ActionError as exc:
            return exc
        try:
            self._link = Link(line, self._keeping.heartbeat)
            keeping = self._keeping
            hello = Hello(
                VERSION, keeping.heartbeat, keeping.token, self._session, keeping.max_frame
            )
            self._link.post(encode(hello))
            self._unopened.clear()
            error = await self._link.run(self._handle, self._openings)
            if type(error) is ProtocolError:
                return ProtocolError(naming(self._where, error))
            return error
        finally:
            self._link = None
            await line.aclose()

    def _give_up(self, error: ActionError) -> None:
        self._absent = lost = error
        if self._patience is not None and not _is_final(error):
            # For what was under way, there was a server, whatever the last attempt has found.
            lost = ConnectionLost(str(error))
        calls = (*self._calls.values(), *self._observed.values())
        self._calls = {}
        self._observed.clear()
        for call in calls:
            call.fail(lost)
        self._end_patience()
        self.changes += 1
        self._changed.notify()

    def _handle(self, frame: bytes) -> None:
        message = decode_from_server(frame)
        # Most belong to a call, so that is looked for first.
        call_id = getattr(message, "id", -1)
        call = self._calls.get(call_id) or self._observed.get(call_id)
        if call is not None and self._ready:
            if call.on_message(message):
                self._drop(call)
        else:
            self._handle_other(message)

    def _handle_other(self, message: FromServer) -> None:
        if isinstance(message, Ping):
            pass
        elif isinstance(message, Goodbye):
            if message.why == Why.FORBIDDEN and not (self._ready or self._keeping.token):
                message.reason += ": give one as token=, or behind the URL as ?token="
            raise error_of_goodbye(message, self._where)
        elif isinstance(message, Welcome):
            self._begin(message)
        elif not self._ready:
            raise ProtocolError(f"the first message was a {type(message).__name__}, no Welcome")
        elif isinstance(message, Ended):
            self._post(Received(message.id))  # nobody wants it any more

    def _begin(self, welcome: Welcome) -> None:
        assert self._link is not None
        if self._ready or welcome.version != VERSION:
            raise ProtocolError(f"a Welcome of version {welcome.version} was not expected")
        self._link.peer_heartbeat = welcome.heartbeat
        self._max_frame = welcome.max_frame
        self._ready = True
        self._absent = None
        self._end_patience()
        self._unopened.extend((*self._calls.values(), *self._observed.values()))
        self._link.wake_writer()
        self.changes += 1
        self._changed.notify()


class RemoteEndpoint(Endpoint):
    """One action at the other end of a connection."""

    def __init__(self, connection: RemoteConnection, info: ActionInfo) -> None:
        self._connection = connection
        self._info = info

    @property
    def info(self) -> ActionInfo:
        return self._info

    async def send_goal(
        self,
        goal_id: GoalID,
        goal: bytes,
        *,
        feedback: bool = True,
        sender: Sender = UNKNOWN_SENDER,
    ) -> RemoteGoal:
        return await self._connection.follow(
            goal_id,
            lambda call_id, credit: SendGoal(
                call_id, self._info.name, goal_id, goal, credit if feedback else None
            ),
        )

    async def feedback(
        self, goal_id: GoalID, *, after: int | None = None, own: bool = False
    ) -> RemoteGoal:
        if after is not None:
            after = min(max(after, 0), LARGEST)  # the server would do so
        return await self._connection.follow(
            goal_id,
            lambda call_id, credit: Follow(call_id, self._info.name, goal_id, after, own, credit),
        )

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        if stamp:  # 0 is no stamp, and any other goes on meaning what it means
            stamp = min(max(stamp, 1), LARGEST)
        answer: CancelAnswered = await self._connection.ask(
            lambda call_id: CancelGoals(call_id, self._info.name, goal_id, stamp), CancelAnswered
        )
        goals = tuple(
            GoalInfo(GoalID(goal), accepted, status) for goal, accepted, status in answer.goals
        )
        return CancelAnswer(CancelCode(answer.return_code), goals, answer.reason)

    async def status(self) -> RemoteStatuses:
        return await self._connection.watch(self._info.name)

    async def wait_for_server(self) -> None:
        while True:
            changes = self._connection.changes
            try:
                await self._connection.ask(
                    lambda call_id: AwaitServer(call_id, self._info.name), Done
                )
                return
            except (ServerNotFound, ConnectionLost, LimitReached) as exc:
                if isinstance(exc, LimitReached) and self._connection.is_open:
                    raise  # this connection has too much under way
                await self._connection.changed(changes)


@asynccontextmanager
async def open_connection(
    dial: Dial, where: str, keeping: ClientSettings
) -> AsyncGenerator[RemoteConnection, None]:
    """A connection for as long as the block lasts.

    Raises:
        ServerNotFound: Nobody answers, and `keeping` says not to try again.
        AuthenticationFailed: The server does not let this client in.
    """
    async with Background() as tasks:
        connection = RemoteConnection(dial, where, keeping)
        tasks.start_soon(connection.run)
        await connection.first_attempt()
        try:
            yield connection
        finally:
            await connection.leave()


def _is_final(error: ActionError) -> bool:
    """Return whether connecting again would end in the same way."""
    return isinstance(error, AuthenticationFailed | InvalidURL | ProtocolError)

"""`RemoteConnection`: the client's half, whose endpoints have their server somewhere else.

Theory of operation
-------------------

A client has one `RemoteConnection` for as long as its block lasts, over as many lines as it takes.
Its parts know each other in one direction only:

- `OpenCalls` has what callers wait for. Each call has an ID that is the same on every line, and
  knows which message opens it: a goal that has not been answered is sent again, one that has is
  followed from the last feedback that arrived.
- `Reconnector` decides when to connect, again and again, and when calls stop waiting.
- `RemoteEndpoint` turns the methods of an `Endpoint` into calls.
- `RemoteConnection` opens a line, says hello, and hands messages to the calls.

A line goes through these steps. `_attempt` opens it and posts `Hello`, which has the version, the
token and the *session*: 16 random bytes, the same on every line of this client, by which the server
knows whose goals are whose. Until `Welcome` comes, nothing else is sent. Then `_begin` tells the
`Reconnector`, and all open calls are opened on this line, each with its own message, as the line
takes them (`openings` is the source of the `Link`).

When the line ends, `_attempt` returns the error that ended it. The calls stay open; the
`Reconnector` opens the next line, or ends them with an error when patience is over. So a caller of
`send_goal` or of a goal's stream does not notice that a line was lost, unless it takes too long.

A connection that the server ends stays ended: a rejected token, another version, or an invalid
message would be the same on the next line, so there is no next line, and calls raise that error.

Leaving says `Goodbye`, so that the server does not wait for this client, and then ends all calls.
"""

from __future__ import annotations

import secrets
from collections.abc import AsyncGenerator, Awaitable, Callable, Coroutine, Iterator
from contextlib import asynccontextmanager
from typing import Any

import anyio

from fibaction._runtime.text import shortened
from fibaction.border.abc import Absence, Connection, Endpoint, GoalRequest, LogLine
from fibaction.border.event_loop import Background
from fibaction.types.action import Action, ActionInfo
from fibaction.wire.channel import Line
from fibaction.wire.client.open_calls import OpenCalls
from fibaction.wire.client.reconnect import Reconnector
from fibaction.wire.client.remote_goal import RemoteGoal
from fibaction.wire.client.remote_statuses import RemoteStatuses
from fibaction.wire.errors import error_of_goodbye
from fibaction.wire.link import FIRST_PING, Link, close_line, naming
from fibaction.wire.messages import (
    LARGEST,
    VERSION,
    Actions,
    AskPeers,
    AwaitServer,
    Done,
    Ended,
    Follow,
    FromServer,
    Goodbye,
    Hello,
    ListActions,
    Peers,
    Ping,
    Received,
    Welcome,
    Why,
    decode_from_server,
    encode,
)
from fibaction.wire.settings import ClientSettings
from fibaction.words.errors import (
    ActionError,
    ConnectionLost,
    LimitReached,
    ProtocolError,
    ServerNotFound,
)
from fibaction.words.goal_query import PastPage
from fibaction.words.goals import ActionPeers, CancelAnswer, GoalID, GoalInfo
from fibaction.words.intake import Intake, IntakeChange

LONGEST_RELEASE = 50
"""Characters of the version of a server, at most."""
OPEN_TIMEOUT = 5.0
"""Seconds that one attempt to connect may take."""
WAITING_GOAL = 64
"""Bytes of a message for each goal that waits in it, at most."""
LEAVE_TIMEOUT = 1.0
"""Seconds that leaving waits for the last messages to be written, and for the server to close."""

OpenLine = Callable[[], Awaitable[Line]]
"""Opens a line; raises `TransportError`."""


def new_session() -> bytes:
    """Return a new secret of a client, by which servers know whose goals are whose."""
    return secrets.token_bytes(16)


class RemoteConnection(Connection):
    """A connection to a server over the lines that `open_line` opens, while its block lasts."""

    def __init__(
        self,
        open_line: OpenLine,
        url: str,
        settings: ClientSettings,
        *,
        session: bytes | None = None,
        ids: Iterator[int] | None = None,
    ) -> None:
        """Let `session` and `ids`, of the calls, be those of other connections of this client."""
        self._open_line = open_line
        self._url = url
        self._settings = settings
        self._session = new_session() if session is None else session
        self._link: Link | None = None
        self.calls = OpenCalls(settings.window, settings.max_frame // WAITING_GOAL, ids)
        """The calls that are open."""
        self._reconnector = Reconnector(url, settings, self._attempt, self.calls.fail)
        self.lost_at: float | None = None
        """Time at which the last line was lost; None while there is one, and before the first."""
        self._release = ""

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        info = action.info if isinstance(action, Action) else action
        return RemoteEndpoint(self.calls, self._reconnector, info)

    async def actions(self) -> list[ActionInfo]:
        answer = await self.calls.ask(lambda call_id: ListActions(call_id), Actions)
        return list(answer.actions)

    async def peers(self, action: str) -> ActionPeers:
        answer: Peers = await self.calls.ask(lambda call_id: AskPeers(call_id, action), Peers)
        return ActionPeers((self._url,), tuple(answer.clients))

    @property
    def release(self) -> str:
        return self._release

    async def first_attempt(self) -> None:
        """Wait until the first attempt to connect has succeeded or failed.

        Raises:
            ActionError: It failed, and there will not be another.
        """
        await self._reconnector.first_attempt()

    async def run(self) -> None:
        """Connect, and connect again, until that is of no use."""
        await self._reconnector.run()

    def end(self, error: ActionError) -> None:
        """End all calls with an error: the server is gone, and nothing is to be sent any more."""
        self._reconnector.stop(error)

    async def leave(self) -> None:
        """Say goodbye, end all calls, and wait until the server has closed the line.

        A line that is closed while the server still writes is reset: the server then learns of that
        before it has read the goodbye, and takes this client for lost.
        """
        link = self._link
        with anyio.move_on_after(LEAVE_TIMEOUT, shield=True):
            try:
                if link is not None:
                    link.post(encode(Goodbye("the client has what it wanted")))
                    await link.flush()
            finally:  # asyncio can cancel the task itself, which no scope shields
                self._reconnector.stop()
            if link is not None:
                await link.ended()

    async def _attempt(self) -> ActionError:
        """Open a line, use it until it ends, and return the error that ended it."""
        try:
            with anyio.fail_after(OPEN_TIMEOUT):
                line = await self._open_line()
        except TimeoutError:
            return ServerNotFound(f"{self._url} did not answer within {OPEN_TIMEOUT:g} s")
        except ActionError as exc:
            return exc
        settings = self._settings
        try:
            link = self._link = Link(line, settings.heartbeat)
            link.first_ping = FIRST_PING
            hello = Hello(
                VERSION,
                settings.heartbeat,
                settings.token,
                self._session,
                settings.max_frame,
                batches=True,
            )
            link.post(encode(hello))
            error = await link.run(self._handle, self.calls.openings)
        finally:
            if self._reconnector.is_open:
                self.lost_at = anyio.current_time()
            self._link = None
            self.calls.detach()
            await close_line(line)
        if type(error) is ProtocolError:
            return ProtocolError(naming(self._url, error))
        return error

    def _handle(self, frame: bytes) -> None:
        message = decode_from_server(frame)
        # Most belong to a call, so that is looked for first.
        if not (self._reconnector.is_open and self.calls.handle(message)):
            self._handle_other(message)

    def _handle_other(self, message: FromServer) -> None:
        if isinstance(message, Ping):
            pass
        elif isinstance(message, Goodbye):
            is_in = self._reconnector.is_open
            if message.why == Why.FORBIDDEN and not (is_in or self._settings.token):
                message.reason += ": give one as token=, or in the URL as ?token="
            raise error_of_goodbye(message, self._url)
        elif isinstance(message, Welcome):
            self._begin(message)
        elif not self._reconnector.is_open:
            raise ProtocolError(f"the first message was a {type(message).__name__}, not a Welcome")
        elif isinstance(message, Ended):
            self.calls.post(Received(message.id))  # of a call that was given up

    def _begin(self, welcome: Welcome) -> None:
        assert self._link is not None
        if self._reconnector.is_open or welcome.version != VERSION:
            raise ProtocolError(f"a Welcome of version {welcome.version} was not expected")
        if self._reconnector.is_final:
            return  # the client is leaving, and its calls have ended
        self._link.heartbeat.agree(welcome.heartbeat, welcome.max_heartbeat)
        self.lost_at = None
        self._release = shortened(welcome.release, LONGEST_RELEASE)
        self.calls.reopen(self._link, welcome.max_frame, welcome.newest)
        self._reconnector.opened()


class RemoteEndpoint(Endpoint):
    """An action whose server is at the other end of a connection."""

    def __init__(self, calls: OpenCalls, reconnector: Reconnector, info: ActionInfo) -> None:
        self._calls = calls
        self._reconnector = reconnector
        self._info = info

    @property
    def info(self) -> ActionInfo:
        return self._info

    def offer_goal(self, request: GoalRequest) -> Coroutine[Any, Any, RemoteGoal]:
        return self._calls.send(self._info.name, request)

    async def feedback(
        self,
        goal_id: GoalID,
        *,
        after: int | None = None,
        own: bool = False,
        attempt: int = 1,
    ) -> RemoteGoal:
        if after is not None:
            after = min(max(after, 0), LARGEST)  # as the server would do
        return await self._calls.follow(
            goal_id,
            lambda call_id, credit: Follow(
                call_id, self._info.name, goal_id, after, own, credit, attempt
            ),
        )

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        return await self._calls.cancel(self._info.name, goal_id, stamp)

    async def status(self) -> RemoteStatuses:
        return await self._calls.follow_statuses(self._info.name)

    async def past_goals(self, page: PastPage) -> list[GoalInfo]:
        return await self._calls.past_goals(self._info.name, page)

    async def intake(self) -> Intake:
        return await self._calls.operate(self._info.name)

    async def change_intake(self, change: IntakeChange) -> Intake:
        return await self._calls.operate(self._info.name, change)

    async def rerun(self, goal_id: GoalID) -> GoalID | None:
        return await self._calls.rerun(self._info.name, goal_id)

    async def log_lines(self, goal_id: GoalID) -> list[LogLine] | None:
        return await self._calls.log_lines(self._info.name, goal_id)

    @property
    def absence(self) -> Absence | None:
        return self._reconnector.absence

    async def wait_for_server(self) -> None:
        while True:
            changes = self._reconnector.changes
            try:
                await self._calls.ask(lambda call_id: AwaitServer(call_id, self._info.name), Done)
                return
            except (ServerNotFound, ConnectionLost, LimitReached) as exc:
                if isinstance(exc, LimitReached) and self._reconnector.is_open:
                    raise  # too many requests are open on this connection
                await self._reconnector.changed(changes)


@asynccontextmanager
async def open_connection(
    open_line: OpenLine, url: str, settings: ClientSettings
) -> AsyncGenerator[RemoteConnection, None]:
    """Open a connection for as long as the block lasts.

    Raises:
        ServerNotFound: The server is not there, and `settings` say not to try again.
        AuthenticationFailed: The server does not let this client in.
        ProtocolError: The server does not speak this protocol.
    """
    async with Background() as tasks:
        connection = RemoteConnection(open_line, url, settings)
        tasks.start_soon(connection.run)
        await connection.first_attempt()
        try:
            yield connection
        finally:
            await connection.leave()

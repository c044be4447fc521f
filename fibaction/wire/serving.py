"""The server's half: takes one client's requests, calls the endpoints, and sends what they say.

It decides nothing about goals. What a client may do is asked of `Access`, before an endpoint is.
"""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from anyio import CancelScope, sleep
from anyio.abc import TaskGroup

from fibaction.abc import Endpoint, FeedbackItem, GoalStream
from fibaction.background import Background
from fibaction.exceptions import (
    ActionError,
    AuthenticationFailed,
    ConnectionLost,
    GoalRejected,
    ProtocolError,
    ServerNotFound,
    UnknownGoal,
)
from fibaction.goals import GoalID
from fibaction.messages import (
    VERSION,
    Actions,
    AwaitServer,
    CancelAnswered,
    CancelGoals,
    Close,
    Credit,
    Done,
    Ended,
    Failed,
    Feedback,
    Finished,
    Follow,
    Following,
    FromClient,
    GoalChanged,
    Goodbye,
    Hello,
    ListActions,
    Ping,
    Rejected,
    SendGoal,
    StatusChanged,
    WatchStatus,
    Welcome,
    Why,
    decode_from_client,
    encode,
)
from fibaction.states import GoalStatus
from fibaction.streams import Waking
from fibaction.wire.access import Access, Peer, Verb
from fibaction.wire.limits import Limits
from fibaction.wire.link import Link
from fibaction.wire.orphans import Orphans

logger = logging.getLogger("fibaction.wire")


class _Flow:
    """How much more a client wants of one request."""

    def __init__(self, credit: int | None) -> None:
        self.credit = credit or 0
        self.closed = credit is None
        """Whether nothing is wanted but the end."""
        self.stop: Callable[[], None] | None = None
        """What to do when the client wants no more."""
        self._more = Waking()
        self._scope: CancelScope | None = None

    def add(self, count: int) -> None:
        """The client wants so much more."""
        self.credit = min(self.credit + count, 2**31)
        self._wake()

    def close(self) -> None:
        """The client wants no more."""
        self.closed = True
        if self.stop is not None:
            self.stop()
        self._wake()

    def stop_with(self, stop: Callable[[], None]) -> None:
        """From now on, this is what to do when the client wants no more."""
        self.stop = stop
        if self.closed:
            stop()

    async def wait(self) -> None:
        """Wait until the client wants more, or no more at all."""
        while self.credit <= 0 and not self.closed:
            await self._more.wait()

    async def next_event(self, stream: GoalStream) -> FeedbackItem | GoalStatus | None:
        """What to send next of a goal: feedback if there is credit for it, statuses always."""
        while self.credit <= 0 and not self.closed:
            event = None
            with CancelScope() as self._scope:
                event = await stream.next_event(feedback=False)
            if event is not None:
                return event
            if not self._scope.cancelled_caught:
                last = await stream.next_event()
                if last is not None:
                    await self.wait()  # the goal has ended, and what is left waits for credit
                return last
        return await stream.next_event()

    def _wake(self) -> None:
        self._more.wake()
        if self._scope is not None:
            self._scope.cancel()


class Session:
    """One client's connection."""

    def __init__(
        self,
        link: Link,
        endpoints: Mapping[str, Endpoint],
        *,
        heartbeat: float,
        access: Access,
        limits: Limits,
        orphans: Orphans,
    ) -> None:
        self._link = link
        self._endpoints = endpoints
        self._heartbeat = heartbeat
        self._access = access
        self._limits = limits
        self._orphans = orphans
        self._peer: Peer | None = None
        self._session = b""
        self._left = False
        self._flows: dict[int, _Flow] = {}
        self._streams: dict[int, GoalStream] = {}
        self._goals = 0
        self._held = 0
        self._progress = Waking()
        self._tasks: TaskGroup
        self._parts: dict[type, Callable[[Any], Awaitable[None]]] = {
            SendGoal: self._send_goal,
            Follow: self._follow,
            CancelGoals: self._cancel_goals,
            WatchStatus: self._watch_status,
            AwaitServer: self._await_server,
            ListActions: self._list_actions,
        }

    async def run(self) -> ActionError:
        """Serve the client until the connection ends, and say why it did."""
        async with Background() as self._tasks:
            self._tasks.start_soon(self._expect_hello)
            error = await self._link.run(self._handle)
            if isinstance(error, ProtocolError | AuthenticationFailed):
                await self._link.say_last(encode(_goodbye(error)))
            return error

    async def drain(self) -> None:
        """Wait until the client has been told of every goal that has ended, and say goodbye."""
        while self._link.is_open and any(
            stream.status.is_terminal for stream in self._streams.values()
        ):
            await self._progress.wait()
        self._link.post(encode(Goodbye("the server is closing the connection")))
        await self._link.flush()

    async def _expect_hello(self) -> None:
        await sleep(self._limits.handshake)
        if self._peer is None:
            self._link.end(
                ProtocolError(f"it has not said hello within {self._limits.handshake:g} s")
            )

    # What arrives

    def _handle(self, frame: bytes) -> None:
        message = decode_from_client(frame)
        if self._peer is None:
            self._welcome(message)
            return
        part = self._parts.get(type(message))
        if part is not None:
            self._begin(part, message)
        elif isinstance(message, Credit):
            if (flow := self._flows.get(message.id)) is not None:
                flow.add(message.count)
        elif isinstance(message, Close):
            if (flow := self._flows.get(message.id)) is not None:
                flow.close()
        elif isinstance(message, Goodbye):
            self._left = True
            # It goes into a log, so it is one line of it, and not of any length.
            reason = "".join(c if c.isprintable() else " " for c in message.reason[:200])
            self._link.end(ConnectionLost(f"{self._link.peer} left: {reason}"))
        elif not isinstance(message, Ping):
            raise ProtocolError("it said hello twice")

    def _welcome(self, message: FromClient) -> None:
        if not isinstance(message, Hello):
            raise ProtocolError(f"its first message was a {type(message).__name__}, not a Hello")
        if message.version != VERSION:
            raise ProtocolError(
                f"it speaks version {message.version} of the protocol, and this is {VERSION}"
            )
        self._peer = self._access.admit(self._link.peer, message.token)
        if self._peer is None:
            raise AuthenticationFailed("its token is not one of this server's")
        self._session = message.session
        self._link.peer_heartbeat = message.heartbeat
        self._link.post(encode(Welcome(VERSION, self._heartbeat)))

    def _begin(self, part: Callable[[Any], Awaitable[None]], message: Any) -> None:
        if message.id in self._flows:
            raise ProtocolError(f"it used the ID {message.id} twice")
        is_goal = isinstance(message, SendGoal | Follow)
        others = len(self._flows) - self._goals
        if (self._goals >= self._limits.goals) if is_goal else (others >= self._limits.requests):
            text = (
                f"too much at once: the limits of a connection are {self._limits.goals} goals"
                f" and {self._limits.requests} other requests"
            )
            refused: Rejected | Failed = Failed(message.id, Why.LIMIT, text)
            if isinstance(message, SendGoal):
                refused = Rejected(message.id, text)
            self._link.post(encode(refused))
            return
        self._flows[message.id] = _Flow(getattr(message, "credit", 0))
        self._goals += is_goal
        self._tasks.start_soon(self._answer, part, message)

    # What is answered

    async def _answer(self, part: Callable[[Any], Awaitable[None]], message: Any) -> None:
        try:
            await part(message)
        except ActionError as exc:
            self._fail(message.id, exc)
        except Exception as exc:
            # An endpoint or a callback of somebody else's: that is its fault, and one client's.
            what = type(message).__name__
            logger.error("%s: its %s failed", self._link.peer, what, exc_info=exc)
            self._fail(message.id, ServerNotFound(f"the server failed: {type(exc).__name__}"))
        finally:
            del self._flows[message.id]
            self._goals -= isinstance(message, SendGoal | Follow)

    def _fail(self, request: int, exc: ActionError) -> None:
        answer: Rejected | Failed
        if isinstance(exc, GoalRejected):
            answer = Rejected(request, _text(exc.reason))
        else:
            answer = Failed(request, _why(exc), _text(str(exc)))
        if self._link.is_open:
            self._link.post(encode(answer))

    async def _endpoint(self, action: str, verb: Verb) -> Endpoint:
        assert self._peer is not None
        if not await self._access.allows(self._peer, action, verb):
            raise AuthenticationFailed(f"this client may not {verb.value} at the action {action!r}")
        try:
            return self._endpoints[action]
        except KeyError:
            known = ", ".join(map(repr, sorted(self._endpoints))) or "nothing"
            raise ServerNotFound(
                f"nobody serves the action {action!r} here: there is {known}"
            ) from None

    async def _send_goal(self, message: SendGoal) -> None:
        size = len(message.goal)
        if self._held + size > self._limits.memory:
            raise GoalRejected(f"too many bytes at once: the limit is {self._limits.memory}")
        self._held += size
        try:
            endpoint = await self._endpoint(message.action, Verb.SEND)
            stream = await endpoint.send_goal(
                GoalID(message.goal_id), message.goal, feedback=message.credit is not None
            )
        finally:
            self._held -= size
        await self._stream_goal(message.id, endpoint, stream, own=True)

    async def _follow(self, message: Follow) -> None:
        goal_id = GoalID(message.goal_id)
        own = message.own and self._orphans.is_own(goal_id, self._session)
        endpoint = await self._endpoint(message.action, Verb.SEND if own else Verb.OBSERVE)
        stream = await endpoint.feedback(goal_id, after=message.after, own=own)
        await self._stream_goal(message.id, endpoint, stream, own=own)

    async def _stream_goal(
        self, request: int, endpoint: Endpoint, stream: GoalStream, *, own: bool
    ) -> None:
        flow = self._flows[request]
        flow.stop_with(stream.close)
        own = own and self._orphans.own(stream, self._session)
        self._streams[request] = stream
        told = False
        try:
            send = self._link.send
            following = Following(request, stream.stamp, stream.status, stream.latest, stream.place)
            await send(encode(following))
            while True:
                if items := stream.ready(flow.credit):
                    flow.credit -= len(items)
                    await self._link.send_all(
                        [encode(Feedback(request, number, payload)) for number, payload in items]
                    )
                    continue
                event = await flow.next_event(stream)
                if event is None:
                    break
                if isinstance(event, GoalStatus):
                    await send(encode(StatusChanged(request, event)))
                else:
                    flow.credit -= 1
                    await send(encode(Feedback(request, event.number, event.payload)))
            end = await stream.outcome()
            reason = _text(end.reason)
            await send(encode(Ended(request, end.status, end.result, reason, stream.place)))
            told = True
        finally:
            del self._streams[request]
            if told or not own:
                self._orphans.end(stream)
            else:
                self._orphans.adopt(endpoint, stream, left=self._left)
            self._progress.wake()

    async def _cancel_goals(self, message: CancelGoals) -> None:
        endpoint = await self._endpoint(message.action, Verb.CANCEL)
        goal_id = None if message.goal_id is None else GoalID(message.goal_id)
        answer = await endpoint.cancel_goals(goal_id, message.stamp)
        goals: list[tuple[bytes, int, int]] = [
            (info.goal_id, info.stamp, info.status) for info in answer.goals_canceling
        ]
        await self._link.send(
            encode(CancelAnswered(message.id, answer.return_code, goals, _text(answer.reason)))
        )

    async def _watch_status(self, message: WatchStatus) -> None:
        flow = self._flows[message.id]
        endpoint = await self._endpoint(message.action, Verb.OBSERVE)
        with await endpoint.status() as statuses:
            flow.stop_with(statuses.close)
            await self._link.send(encode(Done(message.id)))
            while (info := await statuses.receive()) is not None:
                await flow.wait()
                if flow.closed:
                    break
                flow.credit -= 1
                changed = GoalChanged(
                    message.id, info.goal_id, info.stamp, info.status, statuses.dropped
                )
                await self._link.send(encode(changed))
            await self._link.send(encode(Finished(message.id)))

    async def _await_server(self, message: AwaitServer) -> None:
        endpoint = await self._endpoint(message.action, Verb.OBSERVE)
        with CancelScope() as scope:
            self._flows[message.id].stop_with(scope.cancel)
            await endpoint.wait_for_server()
            await self._link.send(encode(Done(message.id)))

    async def _list_actions(self, message: ListActions) -> None:
        infos = [endpoint.info for endpoint in self._endpoints.values()]
        await self._link.send(encode(Actions(message.id, infos)))


def _text(reason: str) -> str:
    """A reason as it can be sent: what is no Unicode in it becomes `?`."""
    return reason.encode("utf-8", "replace").decode()


def _why(exc: ActionError) -> int:
    if isinstance(exc, UnknownGoal):
        return Why.UNKNOWN_GOAL
    if isinstance(exc, AuthenticationFailed):
        return Why.FORBIDDEN
    return Why.SERVER_NOT_FOUND if isinstance(exc, ServerNotFound) else Why.CONNECTION_LOST


def _goodbye(error: ActionError) -> Goodbye:
    why = Why.FORBIDDEN if isinstance(error, AuthenticationFailed) else Why.PROTOCOL
    return Goodbye(f"the server has closed the connection: {error}", why)

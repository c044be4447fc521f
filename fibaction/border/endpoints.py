"""`Endpoint`: an action server as its clients see it, and the base of endpoints around others.

For authors of transports: `fibaction.border.abc` exports all of it, and says what crosses this
border.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine, Iterable
from types import TracebackType
from typing import Any, Protocol, final, runtime_checkable

import msgspec
from anyio import create_task_group, current_time

from fibaction.border.streams import GoalStream, StatusStream
from fibaction.types.action import ActionInfo
from fibaction.words.action_error import ActionError
from fibaction.words.errors import TransportError, UnknownGoal
from fibaction.words.goal_query import GoalQuery, PastPage, read_pages
from fibaction.words.goals import (
    UNKNOWN_OUTCOME,
    UNKNOWN_SENDER,
    CancelAnswer,
    GoalID,
    GoalInfo,
    Outcome,
    Sender,
)
from fibaction.words.intake import FIXED_INTAKE, NO_LEVERS, Intake, IntakeChange
from fibaction.words.meta import Meta

CANCELS_AT_ONCE = 1000
"""Goals that are canceled at the same time, one by one."""


class GoalRequest(msgspec.Struct, frozen=True):
    """A goal that is sent, with everything that goes with it.

    An endpoint passes it on as it is. To change a field, make a copy:

        request = msgspec.structs.replace(request, sender=sender)
    """

    goal_id: GoalID
    """The ID of the goal, made by the client."""
    goal: bytes
    """The payload."""
    feedback: bool = True
    """True to follow feedback and status changes, too; False to follow the outcome only."""
    sender: Sender = UNKNOWN_SENDER
    """The client that sends the goal, for the goal's record; `UNKNOWN_SENDER` if it is not known. A
    connection to another process does not pass it on, since the server there identifies its clients
    itself."""
    deadline: float = math.inf
    """Time, by `anyio.current_time()`, at which the client gives up the goal; `math.inf` if it does
    not. It may be in the past. The executor gets it as `GoalHandle.deadline`, and the server does
    not enforce it. A goal that is sent again keeps its first deadline. To another process, send the
    seconds that are left: its clock is another one."""
    meta: Meta | None = None
    """A small text map that goes with the goal, for traces: see `fibaction.observe.Tracing`; None
    is the same as an empty one. It has at most 8 keys and 4096 bytes. Watchers of the server get
    it; ROS 2 does not carry it."""
    checked: bool = False
    """True if the client has the types of the action, or has compared the goal with its schema. The
    server then ignores a field that its own type does not have, since the client may be of a newer
    version. False to have such a goal rejected: the field is likely misspelled."""


class Absence(msgspec.Struct, frozen=True):
    """The time in which the server of an action cannot be reached."""

    since: float
    """Its begin, in seconds since 1970."""
    reason: str
    """The newest error."""


class LogLine(msgspec.Struct, frozen=True):
    """A log record of an executor."""

    at: int
    """Its time: nanoseconds since 1970."""
    level: str
    """The name of its level, such as `WARNING`."""
    logger: str
    """The name of its logger."""
    text: str
    """Its message, with the end of its traceback."""


class Endpoint(ABC):
    """An action server as its clients see it, in this process or behind a transport."""

    @property
    @abstractmethod
    def info(self) -> ActionInfo:
        """The action that is served here."""

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        if "send_goal" in cls.__dict__:
            raise TypeError(
                f"{cls.__qualname__} overrides send_goal(), which endpoints do not call: write"
                f" offer_goal(self, request), where request is a GoalRequest"
            )

    @abstractmethod
    def offer_goal(self, request: GoalRequest) -> GoalStream | Coroutine[Any, Any, GoalStream]:
        """Take a goal that a client sends, and follow it from its beginning.

        Return the stream if the goal is decided at once, or else a coroutine that waits for it; so
        an endpoint that always waits writes `async def offer_goal`. The coroutine must be awaited
        or closed; until then the goal counts as undecided, and a retry of it blocks. The server
        half of a transport calls this, so that it starts tasks only for goals whose decision takes
        time. Other callers use `send_goal`.

        The same goal may be sent again with the same ID: it gets the same answer and runs once. If
        another client has sent it first, the stream is that of an observer: `stream.own` is False.

        Raises:
            GoalRejected: The server did not accept it; `reason` says why.
            ServerNotFound: This action is not served.
            ConnectionLost: The connection ended before the answer; the goal may have been accepted.
            AuthenticationFailed: This client lacks the permission.
            InvalidMessage: The goal or its `meta` is too large to be sent; nothing was sent.
            ProtocolError: The server sent an invalid message, which ended the connection.
            ServerFailed: The server has a bug.
        """

    @final
    async def send_goal(
        self,
        goal_id: GoalID,
        goal: bytes,
        *,
        feedback: bool = True,
        sender: Sender = UNKNOWN_SENDER,
        timeout: float | None = None,
        meta: Meta | None = None,
        checked: bool = False,
    ) -> GoalStream:
        """Send a goal, and follow it from its beginning: wait for what `offer_goal` returns.

        The arguments are the fields of `GoalRequest`, but for `timeout`: the number of seconds,
        more than 0, after which the client gives up the goal; None if it does not.

        Raises:
            ActionError: As for `offer_goal`.
        """
        deadline = math.inf if timeout is None else current_time() + timeout
        request = GoalRequest(goal_id, goal, feedback, sender, deadline, meta, checked)
        offered = self.offer_goal(request)
        return offered if isinstance(offered, GoalStream) else await offered

    @abstractmethod
    async def feedback(
        self,
        goal_id: GoalID,
        *,
        after: int | None = None,
        own: bool = False,
        attempt: int = 1,
    ) -> GoalStream:
        """Follow a goal that was sent before.

        The stream begins with the next feedback; with `after`, it begins with the feedback that
        follows that number, as far back as the server remembers (the rest counts as dropped). A
        follower never slows the goal down, except with `own=True`, which is for the client that
        sent the goal, lost the stream that `offer_goal` returned, and continues from there.
        `attempt` is the attempt that `after` is a number of. If the goal is in another one by now,
        the stream begins with the first feedback of that one.

        Raises:
            UnknownGoal: The server has no such goal.
            ServerNotFound, ConnectionLost, AuthenticationFailed, ServerFailed: As for `offer_goal`.
            ProtocolError: As for `offer_goal`.
            LimitReached: The server takes no more requests of this client for now.
        """

    @abstractmethod
    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        """Ask the server to cancel goals, by the rules of `action_msgs/srv/CancelGoal`.

        Without arguments, this means all goals; with a stamp, all goals accepted at or before it;
        with an ID, that goal; with both, that goal and all accepted at or before the stamp. A goal
        that is still being decided is canceled by its ID as soon as it is accepted.

        Raises:
            TransportError, ProtocolError: As for `feedback`.
        """

    @abstractmethod
    async def status(self) -> StatusStream:
        """Follow the statuses of all goals.

        Raises:
            TransportError, ProtocolError: As for `feedback`.
        """

    async def past_goals(self, page: PastPage) -> list[GoalInfo]:
        """Return a page of the history: goals that have ended, as the server's store has kept them;
        none if it keeps none, or if the transport does not carry it.

        The server may remember some of them as well: then `status` has them, too.

        Raises:
            TransportError, ProtocolError: As for `feedback`.
        """
        return []

    async def read_past(self, wanted: GoalQuery, take: Callable[[list[GoalInfo]], None]) -> None:
        """Call `take` with all goals of the history that are wanted, in parts and in any order.

        Raises:
            TransportError, ProtocolError: As for `feedback`.
        """
        await read_pages(self.past_goals, wanted, take)

    async def intake(self) -> Intake:
        """Return how the server takes new goals; open and without levers if its transport does not
        tell.

        Raises:
            TransportError, ProtocolError: As for `feedback`.
        """
        return FIXED_INTAKE

    async def change_intake(self, change: IntakeChange) -> Intake:
        """Pause the action, let it take goals again, or drain its server, and return how it takes
        new goals now. The server notes the time.

        Raises:
            TransportError, ProtocolError: As for `feedback`; the transport does not carry it.
        """
        raise TransportError(f"the action {self.info.name!r} stays as it is: {NO_LEVERS}")

    async def rerun(self, goal_id: GoalID) -> GoalID | None:
        """Run a goal again that its server has given up, as a new goal from its last checkpoint.
        Return its ID; None if the goal was not given up, is not kept any more, or runs again
        already.

        Raises:
            TransportError, ProtocolError: As for `feedback`; the transport does not carry it.
        """
        raise TransportError(
            f"goal {goal_id} of the action {self.info.name!r} cannot be run again from here: its"
            " server, or the way to it, does not take that request"
        )

    async def log_lines(self, goal_id: GoalID) -> list[LogLine] | None:
        """Return the newest log records of a goal's executor, the oldest first; None if the server
        keeps none (`log_lines` of its settings), or its transport does not tell them.

        Raises:
            TransportError, ProtocolError: As for `feedback`.
        """
        return None

    @abstractmethod
    async def wait_for_server(self) -> None:
        """Wait until this action is served, without a timeout.

        Raises:
            TransportError, ProtocolError: The connection ended for good, or the server rejects the
                request.
        """

    @property
    def absence(self) -> Absence | None:
        """The absence of the server; None if it can be reached, or if that is not known here.

        The server half of a transport rejects requests during an absence if its clients are better
        served by an answer at once than by one after a long time.
        """
        return None

    def owner_of(self, goal_id: GoalID) -> bytes:
        """Return the owner of a goal, as in `Sender.owner`; empty if it is not known.

        A goal may come from the time before a restart. The server half of a transport recognises
        its client by this.
        """
        return b""

    async def get_result(self, goal_id: GoalID) -> Outcome[bytes]:
        """Wait for the end of a goal, and return its outcome; UNKNOWN if the server has no such
        goal.

        Raises:
            TransportError, ProtocolError: As for `feedback` and `GoalStream.outcome`.
        """
        try:
            stream = await self.feedback(goal_id)
        except UnknownGoal:
            return UNKNOWN_OUTCOME
        with stream:
            return await stream.outcome()


@runtime_checkable
class Startable(Protocol):
    """An endpoint that `serve` starts and stops: an `ActionServer`, or a wrapper of one."""

    @property
    def is_running(self) -> bool:
        """True if it accepts goals; then `serve` neither starts nor stops it."""
        ...

    async def __aenter__(self) -> object:
        """Start."""
        ...

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> bool | None:
        """Stop, and clean up."""
        ...

    async def stop(self) -> None:
        """Reject new goals, and end all active ones. Stopping twice is harmless."""
        ...


class ForwardingEndpoint(Endpoint):
    """An endpoint around another one; subclasses override the methods that are to be different.

        class Audited(ForwardingEndpoint):
            async def cancel_goals(self, goal_id=None, stamp=None):
                log.info("cancel of %s", goal_id)
                return await super().cancel_goals(goal_id, stamp)

        async with serve(Audited(ActionServer(ACTION, executor)), "tcp://127.0.0.1:7400"):
            ...

    Every call is forwarded to `inner`; `offer_goal` sees every goal. The endpoint starts and stops
    `inner`, and runs while `inner` runs; around an endpoint that is not `Startable` it counts as
    running.
    """

    def __init__(self, inner: Endpoint) -> None:
        self.inner = inner
        """The wrapped endpoint."""

    @property
    def info(self) -> ActionInfo:
        return self.inner.info

    async def offer_goal(self, request: GoalRequest) -> GoalStream:
        offered = self.inner.offer_goal(request)
        return offered if isinstance(offered, GoalStream) else await offered

    async def feedback(
        self,
        goal_id: GoalID,
        *,
        after: int | None = None,
        own: bool = False,
        attempt: int = 1,
    ) -> GoalStream:
        return await self.inner.feedback(goal_id, after=after, own=own, attempt=attempt)

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        return await self.inner.cancel_goals(goal_id, stamp)

    async def status(self) -> StatusStream:
        return await self.inner.status()

    async def past_goals(self, page: PastPage) -> list[GoalInfo]:
        return await self.inner.past_goals(page)

    async def read_past(self, wanted: GoalQuery, take: Callable[[list[GoalInfo]], None]) -> None:
        if type(self).past_goals is ForwardingEndpoint.past_goals:
            await self.inner.read_past(wanted, take)
        else:  # it has a history of its own
            await super().read_past(wanted, take)

    async def intake(self) -> Intake:
        return await self.inner.intake()

    async def change_intake(self, change: IntakeChange) -> Intake:
        return await self.inner.change_intake(change)

    async def rerun(self, goal_id: GoalID) -> GoalID | None:
        return await self.inner.rerun(goal_id)

    async def log_lines(self, goal_id: GoalID) -> list[LogLine] | None:
        return await self.inner.log_lines(goal_id)

    async def wait_for_server(self) -> None:
        await self.inner.wait_for_server()

    @property
    def absence(self) -> Absence | None:
        return self.inner.absence

    def owner_of(self, goal_id: GoalID) -> bytes:
        return self.inner.owner_of(goal_id)

    @property
    def is_running(self) -> bool:
        """True if `inner` accepts goals."""
        return not isinstance(self.inner, Startable) or self.inner.is_running

    async def __aenter__(self) -> ForwardingEndpoint:
        """Start `inner`, if it can be started."""
        if isinstance(self.inner, Startable):
            await self.inner.__aenter__()
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Stop `inner`, if it can be stopped."""
        if isinstance(self.inner, Startable):
            await self.inner.__aexit__(exc_type, exc, traceback)

    async def stop(self) -> None:
        """Stop `inner`, if it can be stopped."""
        if isinstance(self.inner, Startable):
            await self.inner.stop()


async def cancel_each(endpoint: Endpoint, goals: Iterable[GoalID]) -> CancelAnswer:
    """Cancel each of these goals, and return one answer. A goal that cannot be asked about now, as
    no worker of its fleet has it, delays no other one, and its error is raised at the end.

    Raises:
        ActionError: The first error.
    """
    answers: list[CancelAnswer] = []
    errors: list[ActionError] = []
    wanted = tuple(goals)
    left = iter(wanted)

    async def cancel() -> None:
        for goal_id in left:  # the next one that no other task has
            try:
                answers.append(await endpoint.cancel_goals(goal_id))
            except ActionError as exc:
                errors.append(exc)

    async with create_task_group() as tasks:
        for _ in range(min(len(wanted), CANCELS_AT_ONCE)):
            tasks.start_soon(cancel)
    if errors:
        raise errors[0]
    return CancelAnswer.merged(answers)

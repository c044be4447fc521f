"""`ActionClient` and `ClientGoal`: sends goals to an endpoint, and follows them.

Everything is typed by the `Action`, and nothing here knows what lies between the client and the
server: that is the endpoint's affair.
"""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable, Coroutine, Generator
from contextlib import AbstractAsyncContextManager, suppress
from operator import index
from types import TracebackType
from typing import Any, Generic

import anyio
from anyio import get_cancelled_exc_class

from fibaction.abc import Endpoint, GoalStream
from fibaction.action import Action, Codec, FeedbackT, GoalT, ResultT
from fibaction.events import Events, events_of
from fibaction.exceptions import (
    ActionError,
    GoalAborted,
    GoalCanceled,
    ServerNotFound,
    UnknownGoal,
)
from fibaction.goals import CancelAnswer, GoalID, GoalInfo, Outcome
from fibaction.states import GoalStatus

LEAVE_TIMEOUT = 5.0
"""Seconds that leaving a goal's block waits for the server's answer to the cancel: more than any
answer takes, and the time within which a dead peer is noticed."""

logger = logging.getLogger(__name__)


class FeedbackReader(Generic[FeedbackT]):
    """The feedback of one goal, to be read with `async for`; it ends when the goal does."""

    def __init__(self, stream: GoalStream, codec: Codec[FeedbackT]) -> None:
        self._stream = stream
        self._codec = codec
        self._reader: int | None = None
        self._holding = True

    def __aiter__(self) -> FeedbackReader[FeedbackT]:
        self._reader = anyio.get_current_task().id
        return self

    async def __anext__(self) -> FeedbackT:
        """The next feedback.

        Raises:
            StopAsyncIteration: The goal has ended, and all its feedback has been read.
            ConnectionLost: The connection ended before the goal did.
            TransportError: As for `ClientGoal.outcome`.
            ProtocolError: The server sent what is not of the feedback's type.
        """
        if not self._holding:
            self._holding = True
            self._stream.hold(True)
        item = await self._stream.receive()
        if item is None:
            raise StopAsyncIteration
        return self._codec.decode(item.payload)

    def let_go(self) -> None:
        """The calling task is about to wait for the result. If it is the one that reads, or nobody
        does, no more will be read for now: do not make the executor wait for it.
        """
        if self._reader is None or self._reader == anyio.get_current_task().id:
            self._holding = False
            self._stream.hold(False)

    def __del__(self) -> None:
        # Nobody can read any more, so the executor is not to wait for that.
        self._stream.close()


class ClientGoal(Generic[FeedbackT, ResultT]):
    """One goal that the server accepted, as its client sees it."""

    def __init__(
        self, endpoint: Endpoint, action: Action[Any, FeedbackT, ResultT], stream: GoalStream
    ) -> None:
        self.feedback = FeedbackReader(stream, action.feedback)
        """The feedback, for `async for`. If nobody reads it, the server keeps the last of it."""
        self._endpoint = endpoint
        self._codec = action.result
        self._stream = stream
        self._outcome: Outcome[ResultT] | None = None

    @property
    def goal_id(self) -> GoalID:
        """The goal's name."""
        return self._stream.goal_id

    @property
    def stamp(self) -> int:
        """When the goal was accepted: nanoseconds since 1970, by the server's clock."""
        return self._stream.stamp

    @property
    def status(self) -> GoalStatus:
        """The status that was last heard of."""
        return self._stream.status

    @property
    def feedback_dropped(self) -> int:
        """How many feedback messages were not delivered because they were not read in time. It is
        known for those before the last one read; at the end of the feedback, for all.
        """
        return self._stream.dropped

    async def outcome(self) -> Outcome[ResultT]:
        """Wait for the end of the goal, and say how it ended.

        While the task that reads the feedback waits here, or nobody reads it, the executor is not
        held up by what is unread.

        Raises:
            ConnectionLost: The connection ended before the goal did.
            TransportError: The server cannot tell the outcome, or may not: for instance, the result
                is larger than this client takes.
            ProtocolError: The server sent what is not of the result's type.
        """
        if self._outcome is None:
            self.feedback.let_go()
            raw = await self._stream.outcome()
            result = None if raw.result is None else self._codec.decode(raw.result)
            self._outcome = Outcome(raw.status, result, raw.reason)
        return self._outcome

    async def result(self) -> ResultT:
        """Wait for the end of the goal, and give its result.

        Raises:
            GoalAborted: It was aborted; `reason` says why, `result` is what there was.
            GoalCanceled: It was canceled; `result` is what there was.
            UnknownGoal: The server does not know of it any more.
            ConnectionLost, TransportError, ProtocolError: As for `outcome`.
        """
        outcome = await self.outcome()
        if outcome.status is GoalStatus.SUCCEEDED:
            return outcome.result  # type: ignore[return-value]  # a success has a result, maybe None
        if outcome.status is GoalStatus.UNKNOWN:
            raise UnknownGoal(self.goal_id)
        error = GoalCanceled if outcome.status is GoalStatus.CANCELED else GoalAborted
        raise error(outcome.reason, result=outcome.result, goal_id=self.goal_id)

    async def cancel(self) -> CancelAnswer:
        """Ask the server to cancel the goal, and give its answer. That the cancel is accepted does
        not mean that the goal will end as CANCELED: see `outcome()`.

        Raises:
            ServerNotFound, ConnectionLost: The server cannot be asked.
            AuthenticationFailed: This client may not cancel.
            TransportError: The server takes no more requests of this client for now.
        """
        return await self._endpoint.cancel_goals(self.goal_id)

    def close(self) -> None:
        """Read no more feedback. The goal goes on, and its outcome can still be waited for."""
        self._stream.close()

    def __repr__(self) -> str:
        return f"<ClientGoal {self.goal_id} {self.status.name}>"


class SendingGoal(Generic[FeedbackT, ResultT]):
    """A goal on its way: `await` it, or use it in `async with`. See `ActionClient.send_goal`."""

    def __init__(
        self,
        client: ActionClient[Any, FeedbackT, ResultT],
        goal_id: GoalID,
        sending: Coroutine[Any, Any, ClientGoal[FeedbackT, ResultT]],
    ) -> None:
        self._client = client
        self._goal_id = goal_id
        self._sending = sending
        self._goal: ClientGoal[FeedbackT, ResultT] | None = None

    def __await__(self) -> Generator[Any, Any, ClientGoal[FeedbackT, ResultT]]:
        return self._sending.__await__()

    async def __aenter__(self) -> ClientGoal[FeedbackT, ResultT]:
        self._client._blocks.add(self)
        try:
            self._goal = await self._sending
        except BaseException:
            self._client._blocks.discard(self)
            raise
        return self._goal

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        assert self._goal is not None
        self._goal.close()
        if self in self._client._blocks:  # else the connection was left, and has canceled the goal
            self._client._blocks.discard(self)
            await self.leave()

    async def leave(self) -> None:
        """Cancel the goal if it has not ended, and wait for the answer; log it if it runs on."""
        goal_id = self._goal_id
        if self._goal is not None:
            if self._goal.status.is_terminal:
                return
            goal_id = self._goal.goal_id
        with anyio.move_on_after(LEAVE_TIMEOUT, shield=True) as patience:
            try:
                answer = await self._client.endpoint.cancel_goals(goal_id)
                if not answer.accepted and answer.reason:
                    logger.warning("goal %s was left, but runs on: %s", goal_id, answer.reason)
            except ActionError as error:
                logger.warning("goal %s was left, but could not be canceled: %s", goal_id, error)
        if patience.cancelled_caught:
            logger.warning("goal %s was left, but its server does not answer the cancel", goal_id)


class ActionClient(Generic[GoalT, FeedbackT, ResultT]):
    """Sends goals of one action to one endpoint. It needs no closing."""

    def __init__(self, endpoint: Endpoint, action: Action[GoalT, FeedbackT, ResultT]) -> None:
        self.endpoint = endpoint
        """The endpoint that the goals are sent to."""
        self.action = action
        self._blocks: set[SendingGoal[FeedbackT, ResultT]] = set()

    def send_goal(
        self, goal: GoalT, *, goal_id: GoalID | None = None
    ) -> SendingGoal[FeedbackT, ResultT]:
        """Send a goal: `await` it, or better, `async with` it.

        `await` gives a `ClientGoal` as soon as the server has accepted; the goal then goes on by
        itself. `async with` gives the same, and leaving the block early cancels the goal; it does
        not wait for the executor's clean-up. Being canceled before the answer is there cancels the
        goal, too. `goal_id` is for those who send the same goal again after an answer was lost.

        Raises:
            GoalRejected: The server did not accept; `reason` says why.
            ServerNotFound: Nobody serves this action.
            ConnectionLost: The connection ended before the answer.
            AuthenticationFailed: This client may not do that.
            ProtocolError: The goal is too large to be sent.
            TypeError, OverflowError: The goal holds what cannot be encoded: see `Codec.encode`.
            TypeError: `goal_id` is no `GoalID`.
        """
        if goal_id is None:
            goal_id = GoalID.random()
        _check_is_id(goal_id)
        return SendingGoal(self, goal_id, self._send(goal, goal_id))

    async def call(
        self,
        goal: GoalT,
        *,
        on_feedback: Callable[[FeedbackT], Awaitable[object] | object] | None = None,
    ) -> ResultT:
        """Send a goal, and give its result; `on_feedback`, sync or async, is called with each
        feedback. Being canceled, or an exception of `on_feedback`, cancels the goal.

        Raises:
            GoalRejected, ServerNotFound, ConnectionLost, AuthenticationFailed, ProtocolError,
                TypeError, OverflowError: As for `send_goal`.
            GoalAborted, GoalCanceled, UnknownGoal, TransportError: As for `ClientGoal.result`.
        """
        goal_id = GoalID.random()
        sending = self._send(goal, goal_id, feedback=on_feedback is not None)
        async with SendingGoal(self, goal_id, sending) as sent:
            if on_feedback is not None:
                async for feedback in sent.feedback:
                    answer = on_feedback(feedback)
                    if isinstance(answer, Awaitable):
                        await answer
            return await sent.result()

    async def attach(
        self, goal_id: GoalID, *, after: int | None = None
    ) -> ClientGoal[FeedbackT, ResultT]:
        """Follow a goal that somebody sent: its feedback from now on, and its result.

        With `after`, the feedback begins behind that number, as far back as the server remembers.

        Raises:
            UnknownGoal: The server has no such goal.
            ServerNotFound, ConnectionLost, AuthenticationFailed: As for `send_goal`.
            TransportError: As for `ClientGoal.cancel`.
            TypeError: `goal_id` is no `GoalID`, or `after` no whole number.
        """
        _check_is_id(goal_id)
        after = None if after is None else index(after)
        stream = await self.endpoint.feedback(goal_id, after=after)
        return ClientGoal(self.endpoint, self.action, stream)

    async def cancel_goals(
        self, goal_id: GoalID | None = None, *, before: int | None = None
    ) -> CancelAnswer:
        """Ask to cancel goals, whoever sent them: all of them; with `before`, those accepted at or
        before that stamp; with `goal_id`, that goal; with both, that goal and those.

        Raises:
            ServerNotFound, ConnectionLost, AuthenticationFailed: As for `send_goal`.
            TransportError: As for `ClientGoal.cancel`.
            TypeError: `goal_id` is no `GoalID`, or `before` no whole number.
        """
        if goal_id is not None:
            _check_is_id(goal_id)
        before = None if before is None else index(before)
        return await self.endpoint.cancel_goals(goal_id, before)

    async def goals(self) -> list[GoalInfo]:
        """Every goal that the server knows: those that have ended, then the active ones.

        Raises:
            ServerNotFound, ConnectionLost, AuthenticationFailed: As for `send_goal`.
            TransportError: As for `ClientGoal.cancel`.
        """
        with await self.endpoint.status() as statuses:
            return await statuses.listed()

    def events(self, *, feedback: bool = True) -> AbstractAsyncContextManager[Events[FeedbackT]]:
        """`async with` this, and `async for` over what it gives: first every goal that the server
        knows, then each change of a status, and, with `feedback`, the feedback of all goals, of new
        ones from the beginning, as far as the server remembers it. A goal's end comes after its
        feedback.

        Raises:
            ServerNotFound, ConnectionLost, AuthenticationFailed: As for `send_goal`.
            TransportError: As for `ClientGoal.cancel`.
        """
        return events_of(self.endpoint, self.action.feedback, feedback=feedback)

    async def wait_for_server(self, timeout: float | None = None) -> None:
        """Return as soon as somebody serves the action.

        Raises:
            ServerNotFound: Nobody did within `timeout` seconds (None: no limit).
            TransportError: The connection ended for good, or the server does not say.
        """
        with anyio.move_on_after(timeout):
            return await self.endpoint.wait_for_server()
        raise ServerNotFound(f"nobody served the action {self.action.name!r} within {timeout:g} s")

    async def leave(self) -> None:
        """Cancel the goals whose block of `send_goal`, or whose `call`, has not ended. Leaving the
        block of `connect` does so before the connection is closed.
        """
        blocks, self._blocks = self._blocks, set()
        async with anyio.create_task_group() as tasks:
            for block in blocks:
                tasks.start_soon(block.leave)

    async def _send(
        self, goal: GoalT, goal_id: GoalID, *, feedback: bool = True
    ) -> ClientGoal[FeedbackT, ResultT]:
        payload = self.action.goal.encode(goal)
        try:
            stream = await self.endpoint.send_goal(goal_id, payload, feedback=feedback)
        except get_cancelled_exc_class():
            # The goal may be on its way, and nobody would ever know of it.
            with anyio.move_on_after(LEAVE_TIMEOUT, shield=True), suppress(ActionError):
                await self.endpoint.cancel_goals(goal_id)
            raise
        return ClientGoal(self.endpoint, self.action, stream)

    def __repr__(self) -> str:
        return f"<ActionClient of {self.action!r}>"


def _check_is_id(goal_id: object) -> None:
    """See it here: a server takes what sends it something else for broken, and hangs up."""
    if not isinstance(goal_id, GoalID):
        raise TypeError(f"a goal is named by a GoalID, as of GoalID.parse(), and not {goal_id!r}")

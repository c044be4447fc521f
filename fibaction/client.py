"""`ActionClient`: send goals to an endpoint, follow and cancel them.

A client calls the methods of an `Endpoint`, which may be a server in the same process or the client
half of a transport. The client adds the types of the `Action`: it encodes goals, and decodes
feedback and results. It keeps no state about goals but one set, `_blocks`.

Sending: `send_goal` returns a `SendingGoal`, which is both awaitable and an async context manager.
Nothing is sent before one of the two begins. If the task is canceled while it waits for the answer,
the goal may have been accepted already; so the client cancels it by its ID, which it made itself.

Following and leaving a goal: see `client_goal`.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager, suppress
from operator import index
from typing import Generic

import anyio
from anyio import get_cancelled_exc_class

from fibaction._own_thread import OwnThread
from fibaction.abc import Endpoint
from fibaction.action import Action, FeedbackT, GoalT, ResultT
from fibaction.client_goal import LEAVE_TIMEOUT, ClientGoal, SendingGoal
from fibaction.events import Events, events_of
from fibaction.exceptions import ActionError, ServerNotFound
from fibaction.goals import CancelAnswer, GoalID, GoalInfo


class ActionClient(Generic[GoalT, FeedbackT, ResultT]):
    """A client of one action at one endpoint, which need not be closed.

    It belongs to one event loop: what waits raises `RuntimeError` in another thread, for this class
    as for `ClientGoal`.
    """

    def __init__(self, endpoint: Endpoint, action: Action[GoalT, FeedbackT, ResultT]) -> None:
        self.endpoint = endpoint
        """The endpoint that the goals are sent to."""
        self.action = action
        self._thread = OwnThread()
        self._blocks: set[SendingGoal[FeedbackT, ResultT]] = set()

    def send_goal(
        self, goal: GoalT, *, goal_id: GoalID | None = None
    ) -> SendingGoal[FeedbackT, ResultT]:
        """Send a goal: `async with` the returned object, or `await` it.

        Both return a `ClientGoal` as soon as the server has accepted the goal. The end of the block
        of `async with` cancels the goal if it has not ended, without waiting for the executor's
        clean-up; after `await`, the goal goes on by itself. A cancellation of the task before the
        answer has arrived cancels the goal, too. `goal_id` serves to send the same goal again after
        its answer was lost.

        Raises:
            GoalRejected: The server did not accept the goal; `reason` says why.
            ServerNotFound: This action is not served.
            ConnectionLost: The connection ended before the answer.
            AuthenticationFailed: This client lacks the permission.
            InvalidMessage: The goal is too large to be sent; nothing was sent.
            ProtocolError: The server sent an invalid message, which ended the connection.
            TypeError, ValueError, OverflowError, RecursionError: The goal cannot be encoded: see
                `Codec.encode`.
            TypeError: `goal_id` is not a `GoalID`.
        """
        if goal_id is None:
            goal_id = GoalID.random()
        _check_is_id(goal_id)
        return SendingGoal(self.endpoint, goal_id, self._send(goal, goal_id), self._blocks)

    async def call(
        self,
        goal: GoalT,
        *,
        on_feedback: Callable[[FeedbackT], Awaitable[object] | object] | None = None,
    ) -> ResultT:
        """Send a goal, and return its result.

        `on_feedback`, sync or async, is called with each feedback. A cancellation of the calling
        task, or an exception of `on_feedback`, cancels the goal. If feedback was lost, for example
        with a connection, the number of lost messages is logged as a warning of
        `fibaction.client`, unless the server's policy is `feedback="latest"`.

        Raises:
            GoalRejected, ServerNotFound, ConnectionLost, AuthenticationFailed, ProtocolError,
                TypeError, ValueError, OverflowError, RecursionError: As for `send_goal`.
            GoalAborted, GoalCanceled, UnknownGoal, TransportError: As for `ClientGoal.result`.
        """
        goal_id = GoalID.random()
        sending = self._send(goal, goal_id, feedback=on_feedback is not None)
        async with SendingGoal(self.endpoint, goal_id, sending, self._blocks) as sent:
            if on_feedback is not None:
                async for feedback in sent.feedback:
                    answer = on_feedback(feedback)
                    if isinstance(answer, Awaitable):
                        await answer
                sent.feedback.warn_of_loss()
            return await sent.result()

    async def attach(
        self, goal_id: GoalID, *, after: int | None = None
    ) -> ClientGoal[FeedbackT, ResultT]:
        """Follow a goal that any client sent: its feedback from now on, and its result.

        With `after`, the feedback begins behind that number, as far back as the server remembers.

        Raises:
            UnknownGoal: The server has no such goal.
            ServerNotFound, ConnectionLost, AuthenticationFailed: As for `send_goal`.
            TransportError: As for `ClientGoal.cancel`.
            TypeError: `goal_id` is not a `GoalID`, or `after` is not a whole number.
        """
        _check_is_id(goal_id)
        after = None if after is None else index(after)
        self._thread.check()
        stream = await self.endpoint.feedback(goal_id, after=after)
        return ClientGoal(self.endpoint, self.action, stream)

    async def cancel_goals(
        self, goal_id: GoalID | None = None, *, before: int | None = None
    ) -> CancelAnswer:
        """Ask the server to cancel goals of any clients.

        Without arguments, this means all goals; with `before`, those accepted at or before that
        stamp; with `goal_id`, that goal; with both, that goal and those.

        Raises:
            ServerNotFound, ConnectionLost, AuthenticationFailed: As for `send_goal`.
            TransportError: As for `ClientGoal.cancel`.
            TypeError: `goal_id` is not a `GoalID`, or `before` is not a whole number.
        """
        if goal_id is not None:
            _check_is_id(goal_id)
        before = None if before is None else index(before)
        self._thread.check()
        return await self.endpoint.cancel_goals(goal_id, before)

    async def goals(self) -> list[GoalInfo]:
        """Return every goal that the server knows: those that have ended, then the active ones.

        Raises:
            ServerNotFound, ConnectionLost, AuthenticationFailed: As for `send_goal`.
            TransportError: As for `ClientGoal.cancel`.
        """
        self._thread.check()
        with await self.endpoint.status() as statuses:
            return await statuses.listed()

    def events(self, *, feedback: bool = True) -> AbstractAsyncContextManager[Events[FeedbackT]]:
        """Return a block whose value is an iterator over all events of the action's goals.

        The events are first every goal that the server knows, then each change of a status, and,
        with `feedback`, the feedback of all goals, of new ones from the beginning, as far back as
        the server remembers. The end of a goal comes after its feedback.

            async with client.events() as events:
                async for event in events:
                    ...

        Raises:
            ServerNotFound, ConnectionLost, AuthenticationFailed: As for `send_goal`.
            TransportError: As for `ClientGoal.cancel`.
        """
        return self._events(feedback)

    @asynccontextmanager
    async def _events(self, feedback: bool) -> AsyncGenerator[Events[FeedbackT], None]:
        self._thread.check()
        async with events_of(self.endpoint, self.action.feedback, feedback=feedback) as events:
            yield events

    async def wait_for_server(self, timeout: float | None = None) -> None:
        """Wait until the action is served.

        Raises:
            ServerNotFound: It was not served within `timeout` seconds (None: no limit).
            TransportError: The connection ended for good, or the server does not answer.
        """
        self._thread.check()
        with anyio.move_on_after(timeout):
            return await self.endpoint.wait_for_server()
        raise ServerNotFound(f"the action {self.action.name!r} was not served within {timeout:g} s")

    async def leave(self) -> None:
        """Cancel the goals of `call`, and of blocks of `send_goal`, that have not ended.

        The end of the block of `connect` calls this, before it closes the connection.
        """
        blocks = tuple(self._blocks)
        self._blocks.clear()
        async with anyio.create_task_group() as tasks:
            for block in blocks:
                tasks.start_soon(block.leave)

    async def _send(
        self, goal: GoalT, goal_id: GoalID, *, feedback: bool = True
    ) -> ClientGoal[FeedbackT, ResultT]:
        self._thread.check()
        payload = self.action.goal.encode(goal)
        try:
            stream = await self.endpoint.send_goal(goal_id, payload, feedback=feedback)
        except get_cancelled_exc_class():
            # The server may have accepted the goal, and it would run without a client.
            with anyio.move_on_after(LEAVE_TIMEOUT, shield=True), suppress(ActionError):
                await self.endpoint.cancel_goals(goal_id)
            raise
        return ClientGoal(self.endpoint, self.action, stream)

    def __repr__(self) -> str:
        return f"<ActionClient of {self.action!r}>"


def _check_is_id(goal_id: object) -> None:
    """Raise TypeError here; a server closes the connection of a client that sends other bytes."""
    if not isinstance(goal_id, GoalID):
        raise TypeError(f"goal_id is a GoalID, as from GoalID.parse(), not {goal_id!r}")

"""`ClientGoal`: one goal that was sent, its feedback and its outcome.

Theory of operation
-------------------

Following: a `ClientGoal` has one `GoalStream`. `feedback` reads it item by item; `outcome` waits
for its end, whether or not the feedback is read. An outcome is decoded once and kept.

Holding: by default, a server loses no feedback of a goal that its own client reads, so the executor
waits for a slow reader. A client that waits for the outcome without reading would wait for an
executor that waits for the client. `outcome` therefore releases the executor (`GoalStream.hold`) if
the calling task is the reader, or if the feedback has no reader; the next read holds it again. A
reader in another task keeps the executor waiting, since that task goes on reading. A feedback
reader that is garbage collected closes its stream, which releases the executor, too.

Leaving: the end of a block of `send_goal`, or of `call`, cancels a goal that has not ended, and
waits for the server's answer for at most LEAVE_TIMEOUT, shielded from a cancellation of the block
itself. If the connection ends first, as at the end of the block of `connect`, then
`ActionClient.leave` cancels the goals of all blocks that are still open, side by side, while the
connection can still carry the cancels. A block that ends afterwards is no longer in `_blocks`, and
does not cancel again.
"""

from __future__ import annotations

from collections.abc import Coroutine, Generator
from types import TracebackType
from typing import Any, Generic

import anyio

from fibaction._log import clean_logger
from fibaction._own_thread import OwnThread
from fibaction._text import excerpt
from fibaction.abc import Endpoint, FeedbackItem, GoalStream
from fibaction.action import Action, Codec, FeedbackT, ResultT
from fibaction.exceptions import ActionError, GoalAborted, GoalCanceled, UnknownGoal
from fibaction.goals import CancelAnswer, GoalID, Outcome
from fibaction.states import GoalStatus

LEAVE_TIMEOUT = 5.0
"""Seconds that the end of a goal's block waits for the answer to its cancel: longer than an answer
takes, and as long as it takes to detect a dead peer."""

logger = clean_logger("fibaction.client")


class FeedbackReader(Generic[FeedbackT]):
    """The feedback of one goal, for `async for`; the iteration ends when the goal does."""

    def __init__(self, stream: GoalStream, codec: Codec[FeedbackT], thread: OwnThread) -> None:
        self._thread = thread
        self._stream = stream
        self._codec = codec
        self._reader: int | None = None
        self._holding = True

    def __aiter__(self) -> FeedbackReader[FeedbackT]:
        self._reader = anyio.get_current_task().id
        return self

    async def __anext__(self) -> FeedbackT:
        """Return the next feedback.

        Raises:
            StopAsyncIteration: The goal has ended, and all its feedback has been read.
            ConnectionLost: The connection ended before the goal did.
            TransportError: As for `ClientGoal.outcome`.
            ProtocolError: The feedback is not of its type.
        """
        self._thread.check()
        if not self._holding:
            self._holding = True
            self._stream.hold(True)
        stream = self._stream
        # Feedback that has arrived need not be awaited. A status is of no use here, and the outcome
        # is given again.
        updates = stream.take() if stream.reads else ()
        item = updates[0] if updates else None
        if not isinstance(item, FeedbackItem):
            item = await stream.receive()
        if item is None:
            raise StopAsyncIteration
        return self._codec.decode(item.payload)

    def release(self) -> None:
        """Stop making the executor wait for this reader, until its next read.

        Does nothing if another task reads. Called by a task that is about to wait for the result.
        """
        if self._reader is None or self._reader == anyio.get_current_task().id:
            self._holding = False
            self._stream.hold(False)

    def warn_of_loss(self) -> None:
        """Log the number of messages that were lost, if the server's policy is to lose none."""
        stream = self._stream
        if stream.dropped and not stream.latest:
            logger.warning(
                "goal %s: %d feedback messages were lost, with a connection or because they were"
                " not read in time",
                stream.goal_id,
                stream.dropped,
            )

    def __del__(self) -> None:
        # The executor must not wait for a reader that no longer exists.
        self._stream.close()


class ClientGoal(Generic[FeedbackT, ResultT]):
    """One accepted goal, as its client sees it."""

    def __init__(
        self, endpoint: Endpoint, action: Action[Any, FeedbackT, ResultT], stream: GoalStream
    ) -> None:
        self._thread = OwnThread()
        self.feedback = FeedbackReader(stream, action.feedback, self._thread)
        """The feedback, for `async for`. While it is not read, the server keeps the newest."""
        self._endpoint = endpoint
        self._codec = action.result
        self._stream = stream
        self._outcome: Outcome[ResultT] | None = None

    @property
    def goal_id(self) -> GoalID:
        """The goal's ID."""
        return self._stream.goal_id

    @property
    def stamp(self) -> int:
        """The time of the acceptance: nanoseconds since 1970, by the server's clock."""
        return self._stream.stamp

    @property
    def status(self) -> GoalStatus:
        """The newest status that this client knows."""
        return self._stream.status

    @property
    def feedback_dropped(self) -> int:
        """The number of feedback messages that were not delivered, because they were not read in
        time.

        It counts the messages before the last one that was read; at the end of the feedback, all.
        """
        return self._stream.dropped

    async def outcome(self) -> Outcome[ResultT]:
        """Wait for the end of the goal, and return its outcome.

        The executor does not wait for unread feedback while this is awaited, unless another task
        reads the feedback.

        Raises:
            ConnectionLost: The connection ended before the goal did.
            TransportError: The outcome cannot be received, for example because the result is larger
                than this client's limit.
            ProtocolError: The result is not of its type.
        """
        self._thread.check()
        if self._outcome is None:
            self.feedback.release()
            raw = await self._stream.outcome()
            result = None if raw.result is None else self._codec.decode(raw.result)
            self._outcome = Outcome(raw.status, result, raw.reason)
        return self._outcome

    async def result(self) -> ResultT:
        """Wait for the end of the goal, and return its result.

        Raises:
            GoalAborted: It was aborted; `reason` says why, `result` is the partial result.
            GoalCanceled: It was canceled; `result` is the partial result.
            UnknownGoal: The server has forgotten the goal.
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
        """Ask the server to cancel the goal, and return its answer.

        An accepted cancel does not mean that the goal will end as CANCELED: see `outcome()`.

        Raises:
            ServerNotFound, ConnectionLost: The server cannot be reached.
            AuthenticationFailed: This client lacks the permission to cancel.
            TransportError: The server has too many requests of this client already.
        """
        self._thread.check()
        return await self._endpoint.cancel_goals(self.goal_id)

    def close(self) -> None:
        """Stop reading feedback. The goal goes on, and `outcome()` still works."""
        self._thread.check()
        self._stream.close()

    def __repr__(self) -> str:
        return f"<ClientGoal {self.goal_id} {self.status.name}>"


class SendingGoal(Generic[FeedbackT, ResultT]):
    """A goal to be sent, by `await` or `async with`: see `ActionClient.send_goal`."""

    def __init__(
        self,
        endpoint: Endpoint,
        goal_id: GoalID,
        sending: Coroutine[Any, Any, ClientGoal[FeedbackT, ResultT]],
        blocks: set[SendingGoal[FeedbackT, ResultT]],
    ) -> None:
        """Prepare to send a goal; `blocks` are the open blocks of its client."""
        self._endpoint = endpoint
        self._goal_id = goal_id
        self._blocks = blocks
        self._sending = sending
        self._goal: ClientGoal[FeedbackT, ResultT] | None = None

    def __await__(self) -> Generator[Any, Any, ClientGoal[FeedbackT, ResultT]]:
        return self._sending.__await__()

    async def __aenter__(self) -> ClientGoal[FeedbackT, ResultT]:
        self._blocks.add(self)
        try:
            self._goal = await self._sending
        except BaseException:
            self._blocks.discard(self)
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
        if self in self._blocks:  # else `ActionClient.leave` has canceled the goal
            self._blocks.discard(self)
            if not self._goal.status.is_terminal:
                await self.leave()

    async def leave(self) -> None:
        """Cancel the goal if it has not ended, wait for the answer, and log if the goal runs on."""
        goal_id = self._goal_id
        if self._goal is not None:
            if self._goal.status.is_terminal:
                return
            goal_id = self._goal.goal_id
        with anyio.move_on_after(LEAVE_TIMEOUT, shield=True) as timeout:
            try:
                answer = await self._endpoint.cancel_goals(goal_id)
                if not answer.accepted and answer.reason:
                    reason = excerpt(answer.reason)
                    logger.warning("goal %s was left, but runs on: %s", goal_id, reason)
            except ActionError as error:
                logger.warning("goal %s was left, but could not be canceled: %s", goal_id, error)
        if timeout.cancelled_caught:
            logger.warning("goal %s was left, but its server does not answer the cancel", goal_id)

"""`ClientGoal`: one goal that was sent, its feedback and its outcome.

Theory of operation
-------------------

Following: a `ClientGoal` has one `GoalStream`. `feedback` reads it item by item; `outcome` waits
for its end, whether or not the feedback is read. An outcome is decoded once and kept.

Holding: a client that waits for the outcome does not make the executor wait for a reader: see
`feedback_reader`.

Leaving: the end of a block of `send_goal`, or of `call`, cancels a goal that has not ended, and
waits for the server's answer for a few seconds at most, shielded from a cancellation of the block
itself: see `attempts.cancel_left`. If the connection ends first, as at the end of the block of
`connect`, then `ActionClient.leave` cancels the goals of all blocks that are still open, side by
side, while the connection can still carry the cancels. A block that ends afterwards is no longer in
`_blocks`, and does not cancel again.

Timeouts and retries: see `attempts`.
"""

from __future__ import annotations

from collections.abc import Coroutine, Generator
from types import TracebackType
from typing import TYPE_CHECKING, Any, Generic, NoReturn, TypeAlias

import anyio

from fibaction._runtime.async_only import AsyncBlock, AsyncItems, HasResult, OwnThread
from fibaction.border.abc import Endpoint, GoalStream
from fibaction.border.watchers import NO_SPAN, GoalSpan
from fibaction.client.attempts import Attempts, cancel_left
from fibaction.client.feedback_reader import LOOP, FeedbackReader
from fibaction.types.action import Action, FeedbackT, ResultT
from fibaction.words.errors import ActionError, GoalAborted, GoalCanceled, UnknownGoal
from fibaction.words.goals import CancelAnswer, GoalID, Outcome
from fibaction.words.statuses import GoalStatus

BLOCK = "async with client.send_goal(...) as goal:"


class ClientGoal(AsyncItems, AsyncBlock, HasResult, Generic[FeedbackT, ResultT]):
    """One accepted goal, as its client sees it.

    For example:

        async with client.send_goal(3) as goal:
            async for meters in goal.feedback:
                print(meters)
            print(await goal.result())
    """

    opened_by, read_by, result_by = BLOCK, LOOP, "await goal.result()"

    def __init__(
        self,
        endpoint: Endpoint,
        action: Action[Any, FeedbackT, ResultT],
        stream: GoalStream,
        thread: OwnThread,
        attempts: Attempts | None = None,
        span: GoalSpan = NO_SPAN,
    ) -> None:
        """Make a goal that belongs to the thread of its client."""
        self._thread = thread
        self.feedback = FeedbackReader(stream, action.feedback, thread, attempts, endpoint, span)
        """The feedback, for `async for`. While it is not read, the server keeps the newest."""
        self._endpoint = endpoint
        self._codec = action.result
        self._outcome: Outcome[ResultT] | None = None

    @property
    def goal_id(self) -> GoalID:
        """The goal's ID."""
        return self.feedback.stream.goal_id

    @property
    def stamp(self) -> int:
        """The time of the acceptance: nanoseconds since 1970, by the server's clock."""
        return self.feedback.stream.stamp

    @property
    def status(self) -> GoalStatus:
        """The newest status that this client knows."""
        return self.feedback.stream.status

    @property
    def attempt(self) -> int:
        """The newest attempt at the goal that this client knows, from 1.

        A server that keeps its goals in a store may run a goal again after a restart. The feedback
        of the new attempt follows what is unread of the previous one.
        """
        return self.feedback.stream.newest_attempt

    @property
    def feedback_dropped(self) -> int:
        """The number of feedback messages that were not delivered, because they were not read in
        time.

        It counts messages before the last one that was read and, once the feedback has ended,
        all of them.
        The rest of an attempt that ended with its server is not known, and not counted.
        """
        return self.feedback.dropped

    def __aiter__(self) -> FeedbackReader[FeedbackT]:
        """Iterate over the feedback: `async for feedback in goal`."""
        return self.feedback.__aiter__()

    async def outcome(self) -> Outcome[ResultT]:
        """Wait for the end of the goal, and return its outcome.

        The executor does not wait for unread feedback while this is awaited, unless another task
        reads the feedback.

        Raises:
            GoalTimeout: The goal took longer than its `timeout`, and was canceled.
            ConnectionLost: The connection ended before the goal did.
            TransportError: The outcome cannot be received, for example because the result is larger
                than this client's limit.
            ProtocolError: The result is not of its type.
        """
        self._thread.check()
        if self._outcome is None:
            try:
                raw = await self.feedback.outcome()
            except ActionError as exc:
                self.feedback.span.failed(exc)
                raise
            self.feedback.span.ended(raw)
            self._outcome = raw.decoded(self._codec.decode)
        return self._outcome

    async def result(self) -> ResultT:
        """Wait for the end of the goal, and return its result.

        Raises:
            GoalAborted: It was aborted; `reason` says why, `result` is the partial result.
            GoalCanceled: It was canceled; `result` is the partial result.
            UnknownGoal: The server has forgotten the goal.
            GoalTimeout, ConnectionLost, TransportError, ProtocolError: As for `outcome`.
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
        """Stop reading feedback. The goal continues, and `outcome()` still works."""
        self._thread.check()
        self.feedback.stream.close()

    def __repr__(self) -> str:
        return f"<ClientGoal {self.goal_id} {self.status.name}>"


class SendingGoal(AsyncBlock, Generic[FeedbackT, ResultT]):
    """A goal to be sent: `async with` cancels it at the end of the block, `await` does not.

    See `ActionClient.send_goal`.
    """

    opened_by = BLOCK

    def __init__(
        self,
        endpoint: Endpoint,
        goal_id: GoalID,
        sending: Coroutine[Any, Any, ClientGoal[FeedbackT, ResultT]],
        blocks: Blocks,
        attempts: Attempts | None = None,
    ) -> None:
        """Prepare to send a goal; `blocks` are the open blocks of its client."""
        self._endpoint = endpoint
        self._goal_id = goal_id
        self._blocks = blocks
        self._attempts = attempts
        self._sending = sending
        self._goal: ClientGoal[FeedbackT, ResultT] | None = None

    def __await__(self) -> Generator[Any, Any, ClientGoal[FeedbackT, ResultT]]:
        return self._sending.__await__()

    # For type checkers, each name would be an attribute.
    if not TYPE_CHECKING:  # pragma: no branch  # it is always true at run time

        def __getattr__(self, name: str) -> NoReturn:
            raise AttributeError(
                f"the goal has no attribute {name!r}, because it was not sent: write"
                f" `goal = await client.send_goal(...)`, or"
                f" `async with client.send_goal(...) as goal`"
            )

    async def __aenter__(self) -> ClientGoal[FeedbackT, ResultT]:
        self._blocks[self] = None
        try:
            self._goal = await self._sending
        except BaseException:
            self._blocks.pop(self, None)
            raise
        return self._goal

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        assert self._goal is not None
        feedback, stream = self._goal.feedback, self._goal.feedback.stream
        stream.close()
        feedback.span.left(stream, exc)
        if self in self._blocks:  # else `ActionClient.leave` has canceled the goal
            del self._blocks[self]
            if not stream.status.is_terminal:
                await self.leave()

    def attach(self) -> None:
        """Let the end of the client's block cancel the goal, as if the goal had a block here."""
        self._blocks[self] = None

    def detach(self) -> None:
        """Let the goal continue on its own: the end of a block no longer cancels it."""
        self._blocks.pop(self, None)

    async def leave(self) -> None:
        """Cancel the goal if it has not ended, wait for the answer, and log if it keeps running."""
        goal_id = self._goal_id
        if self._goal is not None:
            if self._goal.status.is_terminal:
                return
            goal_id = self._goal.goal_id
        if self._attempts is not None:
            self._attempts.stop()
            await self._attempts.give_up()
        else:
            await cancel_left(self._endpoint, goal_id)


Blocks: TypeAlias = dict[SendingGoal[Any, Any], None]
"""The open blocks of goals of a client or of a connection, in their order."""


async def leave_blocks(blocks: Blocks) -> None:
    """Cancel the goals of open blocks, side by side, and close the blocks."""
    left = tuple(blocks)
    blocks.clear()
    async with anyio.create_task_group() as tasks:
        for block in left:
            tasks.start_soon(block.leave)

"""`FeedbackReader`: the feedback of one goal, for `async for`.

Theory of operation
-------------------

Holding: by default, a server loses no feedback of a goal that its own client reads, so the executor
waits for a slow reader. A client that waits for the outcome without reading would wait for an
executor that waits for the client. `outcome` therefore releases the executor (`GoalStream.hold`) if
the calling task is the reader, or if the feedback has no reader; the next read holds it again. A
reader in another task keeps the executor waiting, since that task keeps reading. A feedback
reader that is garbage collected closes its stream, which releases the executor, too.

Timeouts and retries: a goal that has either has `Attempts`, through which the reader waits. It has
the stream, which is another one after a retry.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextvars import ContextVar
from threading import get_ident
from typing import Generic, TypeVar

import anyio

from fibaction._runtime.async_only import AsyncItems, OwnThread
from fibaction._runtime.log import clean_logger
from fibaction.border.abc import Endpoint, FeedbackItem, GoalStream
from fibaction.border.watchers import NO_SPAN, GoalSpan
from fibaction.client.attempts import Attempts
from fibaction.types.action import Codec, FeedbackT
from fibaction.words.errors import ConnectionLost
from fibaction.words.goals import Outcome

T = TypeVar("T")

logger = clean_logger("fibaction.client")

LOOP = "async for feedback in goal.feedback:"

CALLER: ContextVar[int] = ContextVar("CALLER", default=0)
"""The thread on whose behalf a task of `fibaction.blocking` runs; 0 for a task of its own."""


def _caller() -> int:
    """Return the task that reads or waits, or the thread that waits for this task."""
    return CALLER.get() or anyio.get_current_task().id


class FeedbackReader(AsyncItems, Generic[FeedbackT]):
    """The feedback of one goal, for `async for`; the iteration ends when the goal does."""

    read_by = LOOP

    def __init__(
        self,
        stream: GoalStream,
        codec: Codec[FeedbackT],
        thread: OwnThread,
        attempts: Attempts | None = None,
        endpoint: Endpoint | None = None,
        span: GoalSpan = NO_SPAN,
    ) -> None:
        self.stream = stream
        self.span = span
        self.at = 0
        """The time at which the executor reported the feedback that was read last: nanoseconds
        since 1970, by the server's clock; 0 before the first. Where that is not told, as by a
        server of ROS, it is the time of the arrival."""
        self._endpoint = endpoint  # of a connection that is not to be collected before its reader
        self._thread = thread
        self._codec = codec
        self._attempts = attempts
        self._dropped = 0  # before this stream
        self._reader: int | None = None
        self._holding = True
        self._waits = False

    def __aiter__(self) -> FeedbackReader[FeedbackT]:
        self._reader = _caller()
        return self

    async def __anext__(self) -> FeedbackT:
        """Return the next feedback.

        Raises:
            StopAsyncIteration: The goal has ended, and all its feedback has been read.
            RuntimeError: Another task waits for the next feedback, and would get a part of it.
            GoalTimeout: As for `ClientGoal.outcome`.
            ConnectionLost: The connection ended before the goal did.
            TransportError: As for `ClientGoal.outcome`.
            ProtocolError: The feedback is not of its type.
        """
        if self._thread.ident != get_ident():  # else without a call: each message is here
            self._thread.check()
        if self._waits:
            raise RuntimeError(
                f"another task or thread waits for the feedback of goal {self.stream.goal_id}, and"
                f" each message has one reader: get another one by `client.attach(goal_id)`"
            )
        if not self._holding:
            self._holding = True
            self.stream.hold(True)
        if self._attempts is not None:
            return await self._next_in_time(self._attempts)
        stream = self.stream
        while stream.reads:  # as in `GoalStream.receive`
            updates = stream.take()
            if not updates:
                self._waits = True
                try:
                    await stream.news.wait()
                finally:
                    self._waits = False
            elif isinstance(update := updates[0], FeedbackItem):
                self.at = update.at
                return self._codec.decode(update.payload)
            elif isinstance(update, Outcome):
                break
        raise StopAsyncIteration

    async def _next_in_time(self, attempts: Attempts) -> FeedbackT:
        self._waits = True
        try:
            item = await self._wait(attempts, GoalStream.receive)
        finally:
            self._waits = False
        if item is None:
            raise StopAsyncIteration
        self.at = item.at
        feedback = self._codec.decode(item.payload)
        attempts.note_feedback(feedback)
        return feedback

    async def outcome(self) -> Outcome[bytes]:
        """Wait for the end of the goal, and return its outcome.

        The executor does not wait for this reader meanwhile, unless another task reads.

        Raises:
            GoalTimeout, ConnectionLost, TransportError: As for `ClientGoal.outcome`.
        """
        if self._attempts is not None:
            self._release()
            return await self._wait(self._attempts, GoalStream.outcome)
        outcome = self.stream.known_outcome()
        if outcome is None:
            self._release()
            outcome = await self.stream.outcome()
        return outcome

    async def _wait(self, attempts: Attempts, wait: Callable[[GoalStream], Awaitable[T]]) -> T:
        """Wait for something of the stream, and follow the goal again if the connection is lost, as
        far as the goal's attempts allow.
        """
        while True:
            stream = self.stream
            try:
                return await attempts.wait(stream, wait)
            except ConnectionLost as exc:
                error = exc
            try:
                self.stream = await attempts.follow_again(error, stream)
            finally:
                del error  # its traceback references this frame
            self._dropped += stream.dropped
            if not self._holding:
                self.stream.hold(False)

    @property
    def number(self) -> int:
        """The number of the feedback that was read last, from 1; 0 before the first.

        It is what `ActionClient.attach` takes as `after`, to continue after this feedback. A
        message that was not delivered has a number, too. Each attempt at the goal has numbers of
        its own.
        """
        return self.stream.cursor

    @property
    def attempt(self) -> int:
        """The attempt at the goal that `number` belongs to, from 1."""
        return self.stream.attempt

    @property
    def dropped(self) -> int:
        """The number of feedback messages that were not delivered."""
        return self._dropped + self.stream.dropped

    def __repr__(self) -> str:
        return f"<FeedbackReader number={self.number} dropped={self.dropped}>"

    def _release(self) -> None:
        """Stop making the executor wait for this reader, until its next read.

        Does nothing if another task reads.
        """
        if self._reader is None or self._reader == _caller():
            self._holding = False
            self.stream.hold(False)

    def warn_of_loss(self) -> None:
        """Log the number of messages that were lost, if the server's policy is to lose none."""
        stream = self.stream
        if self.dropped and not stream.latest:
            logger.warning(
                "goal %s: %d feedback messages were lost, with a connection or because they were"
                " not read in time",
                stream.goal_id,
                self.dropped,
            )

    def __del__(self) -> None:
        # The executor must not wait for a reader that no longer exists.
        if self.stream.reads:
            self.stream.close()
        self.span.left(self.stream)

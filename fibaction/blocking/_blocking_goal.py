"""`BlockingGoal`: one goal that was sent, its feedback and its outcome."""

from __future__ import annotations

from contextlib import closing
from types import TracebackType
from typing import Any, Generic, TextIO

from fibaction._runtime.async_only import HasResult
from fibaction.blocking._loop_thread import LoopThread
from fibaction.client.feedback_reader import FeedbackReader
from fibaction.client.goal import ClientGoal, SendingGoal
from fibaction.client.track import ProgressLine
from fibaction.types.action import FeedbackT, ResultT
from fibaction.words.goals import CancelAnswer, GoalID, Outcome
from fibaction.words.statuses import GoalStatus


class BlockingFeedback(Generic[FeedbackT]):
    """The feedback of one goal, for `for`; the iteration ends when the goal does."""

    def __init__(self, loop: LoopThread, reader: FeedbackReader[FeedbackT]) -> None:
        self._loop = loop
        self._reader = reader

    def __iter__(self) -> BlockingFeedback[FeedbackT]:
        async def begin() -> None:
            self._reader.__aiter__()

        self._loop.run(begin)
        return self

    def __next__(self) -> FeedbackT:
        """Wait for the next feedback, and return it.

        Raises:
            StopIteration: The goal has ended, and all its feedback has been read.
            ActionError: As for `ClientGoal.feedback`.
        """
        try:
            return self._loop.run(self._reader.__anext__)
        except StopAsyncIteration:
            pass
        raise StopIteration

    @property
    def number(self) -> int:
        """The number of the feedback that was read last, from 1: see `FeedbackReader.number`."""
        return self._reader.number

    @property
    def at(self) -> int:
        """The time at which the executor reported it: see `FeedbackReader.at`."""
        return self._reader.at

    @property
    def attempt(self) -> int:
        """The attempt at the goal that `number` belongs to, from 1."""
        return self._reader.attempt

    @property
    def dropped(self) -> int:
        """The number of feedback messages that were not delivered."""
        return self._reader.dropped

    def __repr__(self) -> str:
        return f"<BlockingFeedback number={self.number} dropped={self.dropped}>"


class BlockingGoal(HasResult, Generic[FeedbackT, ResultT]):
    """One accepted goal, as its client sees it; the end of its `with` block cancels it.

    The methods are those of `ClientGoal`, and wait. Several threads may use one goal; one of them
    reads its feedback.

    For example:

        with client.send_goal(3) as goal:
            for meters in goal.feedback:
                print(meters)
            print(goal.result())
    """

    result_by = "goal.result()"

    def __init__(
        self,
        loop: LoopThread,
        goal: ClientGoal[FeedbackT, ResultT],
        sending: SendingGoal[FeedbackT, ResultT] | None,
    ) -> None:
        self._loop = loop
        self._goal = goal
        self._sending = sending
        self._is_detached = False
        self.feedback = BlockingFeedback(loop, goal.feedback)
        """The feedback, for `for`. While it is not read, the server keeps the newest."""
        if sending is not None:
            loop.sent(sending)

    def __enter__(self) -> BlockingGoal[FeedbackT, ResultT]:
        if self._sending is not None and not self._is_detached:
            self._loop.begin_block(self._sending)
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Cancel the goal, if it was sent here and has not ended."""
        sending = self._sending
        if sending is None:
            self.close()
        else:
            self._loop.run(lambda: sending.__aexit__(None, None, None))

    def __iter__(self) -> BlockingFeedback[FeedbackT]:
        """Iterate over the feedback: `for feedback in goal`."""
        return iter(self.feedback)

    @property
    def goal_id(self) -> GoalID:
        """The goal's ID."""
        return self._goal.goal_id

    @property
    def stamp(self) -> int:
        """The time of the acceptance: nanoseconds since 1970, by the server's clock."""
        return self._goal.stamp

    @property
    def status(self) -> GoalStatus:
        """The newest status that this client knows."""
        return self._goal.status

    @property
    def attempt(self) -> int:
        """The newest attempt at the goal that this client knows, from 1."""
        return self._goal.attempt

    @property
    def feedback_dropped(self) -> int:
        """The number of feedback messages that were not delivered: see `ClientGoal`."""
        return self._goal.feedback_dropped

    def outcome(self) -> Outcome[ResultT]:
        """Wait for the end of the goal, and return its outcome.

        Raises:
            ActionError: As for `ClientGoal.outcome`.
        """
        outcome = self._loop.run(self._goal.outcome)
        self.detach()  # it has ended, and its connection need not keep it
        return outcome

    def result(self) -> ResultT:
        """Wait for the end of the goal, and return its result.

        Raises:
            GoalAborted: It was aborted; `reason` says why, `result` is the partial result.
            GoalCanceled: It was canceled; `result` is the partial result.
            ActionError: As for `ClientGoal.result`.
        """
        self.outcome()
        return self._loop.run(self._goal.result)

    def cancel(self) -> CancelAnswer:
        """Ask the server to cancel the goal, and return its answer.

        Raises:
            ActionError: As for `ClientGoal.cancel`.
        """
        return self._loop.run(self._goal.cancel)

    def detach(self) -> None:
        """Let the goal continue on its own: the end of a block no longer cancels it."""
        self._is_detached = True
        if self._sending is not None:
            self._sending.detach()

    def close(self) -> None:
        """Stop reading feedback. The goal continues, and `outcome()` still works."""

        async def close() -> None:
            self._goal.close()

        self._loop.run(close)

    def __repr__(self) -> str:
        return f"<BlockingGoal {self.goal_id} {self.status.name}>"


def track(
    goal: BlockingGoal[Any, ResultT], text: str = "", *, file: TextIO | None = None
) -> ResultT:
    """Read the feedback of a goal, show its progress on one line, and return its result.

    For example:

        with client.send_goal(files) as goal:
            copied = track(goal, "copying")

    The line is that of `fibaction.track`.

    Raises:
        GoalAborted, GoalCanceled, GoalTimeout, UnknownGoal: As for `BlockingGoal.result`.
        ActionError: As for `BlockingGoal.result`.
    """
    with closing(ProgressLine(text, file)) as line:
        for feedback in goal.feedback:
            line.show(feedback, goal.feedback.number)
        result = goal.result()
        line.fill()
    return result

"""`Attempts`: the attempts at one goal of a client, within the goal's timeout.

Theory of operation
-------------------

Only a goal with a timeout or with a `Retry` has an `Attempts`. The deadline is fixed when `send`
begins. From then on, each wait for the goal ends at the deadline: the answer to the goal, the
pauses between attempts, feedback, and the outcome. The first wait that reaches the deadline cancels
the goal, as the end of a block does (`cancel_left`), and every wait raises `GoalTimeout`. No task
watches the deadline: a goal that no task waits for is not canceled. An outcome that has arrived
counts, however late it is read.

A goal is sent again by the rules of goal IDs, always with the same ID. Until its acceptance is
known, `send` sends the goal again: a server that knows the goal repeats its answer. After that,
`follow_again` follows the goal after the last feedback that was read. A goal that the server does
not know any more is an `UnknownGoal` then, since sending it could run it a second time.

`_may_run` says whether the server may have accepted the goal. If so, a cancellation of the caller
cancels the goal as well.
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from typing import NoReturn, TypeVar, cast

import anyio
import msgspec
from anyio import CancelScope, current_time, get_cancelled_exc_class

from fibaction._runtime.log import clean_logger
from fibaction._runtime.notify import Notifier
from fibaction._runtime.text import excerpt
from fibaction.border.abc import Endpoint, GoalRequest, GoalStream
from fibaction.client.retry import Retry
from fibaction.words.errors import ActionError, ConnectionLost, GoalTimeout, copy_of
from fibaction.words.goals import GoalID
from fibaction.words.plain_data import check_is_number
from fibaction.words.statuses import GoalStatus

T = TypeVar("T")

LEAVE_TIMEOUT = 5.0
"""Seconds to wait for the answer to the cancel of a goal that its client leaves: longer than an
answer takes, and as long as it takes to detect a dead peer."""

MOST_UNANSWERED = 4.0
"""Seconds of `LEAVE_TIMEOUT` that may be over before the cancel, if the server has not answered the
goal either: it may be dead since then."""

STATUS_TIMEOUT = 1.0
"""Seconds to wait for the status of a goal that has timed out; the cancel comes afterwards."""

logger = clean_logger("fibaction.client")


async def cancel_left(endpoint: Endpoint, goal_id: GoalID, *, unanswered: float = 0.0) -> None:
    """Cancel a goal that its client leaves, wait for the answer, and log if the goal keeps running.

    `unanswered` are the seconds for which the server has not answered the goal.
    """
    seconds = LEAVE_TIMEOUT - min(unanswered, MOST_UNANSWERED)
    with anyio.move_on_after(seconds, shield=True) as timeout:
        try:
            answer = await endpoint.cancel_goals(goal_id)
            if not answer.accepted and answer.reason:
                reason = excerpt(answer.reason)
                logger.warning("goal %s was left, but runs on: %s", goal_id, reason)
        except ActionError as error:
            logger.warning("goal %s was left, but could not be canceled: %s", goal_id, error)
    if timeout.cancelled_caught:
        logger.warning("goal %s was left, but its server does not answer the cancel", goal_id)


def check_timeout(timeout: float | None) -> None:
    """Check the timeout of a goal.

    Raises:
        TypeError: It is not a number.
        ValueError: It is not more than 0.
    """
    if timeout is None:
        return
    check_is_number("timeout", timeout)
    if not timeout > 0:
        raise ValueError(
            f"timeout must be more than 0 seconds, or None for no limit, not {timeout}"
        )


class Attempts:
    """The attempts at one goal, within its timeout."""

    __slots__ = (
        "_count",
        "_deadline",
        "_endpoint",
        "_error",
        "_expired",
        "_feedback",
        "_feedback_count",
        "_goal_id",
        "_may_run",
        "_retry",
        "_stopped",
        "_timeout",
        "is_given_up",
    )

    def __init__(
        self, endpoint: Endpoint, goal_id: GoalID, timeout: float | None, retry: Retry | None
    ) -> None:
        """Limit and repeat the waits for a goal; `timeout` or `retry` is given.

        Raises:
            TypeError, ValueError: One of them is not what it has to be.
        """
        check_timeout(timeout)
        if not isinstance(cast("object", retry), Retry | None):
            raise TypeError(f"retry must be a Retry, such as Retry(attempts=3), not {retry!r}")
        self._endpoint = endpoint
        self._goal_id = goal_id
        self._timeout = math.inf if timeout is None else timeout
        self._retry = retry
        self._stopped = Notifier()
        self._deadline = math.inf
        self._count = 1
        self._error: ActionError | None = None  # that ended the attempt before this one
        self._may_run = False
        self._expired: GoalTimeout | None = None  # the error of the first wait that was too long
        self._feedback: object = None
        self._feedback_count = 0
        self.is_given_up = False
        """True if the goal was canceled here, so that the end of its block need not cancel it."""

    def stop(self) -> None:
        """Make no more attempts: the connection is being left."""
        self._retry = None
        self._stopped.notify()

    def note_feedback(self, feedback: object) -> None:
        """Note feedback that was read, to tell it in a `GoalTimeout`."""
        self._feedback = feedback
        self._feedback_count += 1

    # Waits

    async def send(self, request: GoalRequest) -> GoalStream:
        """Send the goal until the server has accepted it, and return its stream; its deadline is
        set here.

        Raises:
            GoalTimeout: The time is over.
            ActionError: The error of the last attempt.
        """
        self._deadline = current_time() + self._timeout
        request = msgspec.structs.replace(request, deadline=self._deadline)
        return await self._reach(lambda: self._send(request), None)

    async def wait(self, stream: GoalStream, wait: Callable[[GoalStream], Awaitable[T]]) -> T:
        """Wait for something of the stream.

        Raises:
            GoalTimeout: The time is over, and the outcome has not arrived.
        """
        if current_time() < self._deadline:
            with CancelScope(deadline=self._deadline):
                return await wait(stream)
            if self._expired is not None:  # the outcome may be that of another wait's cancel
                await self._expire(stream.status)
        if stream.known_outcome() is None:
            status = await self._status_of(stream)
            if stream.known_outcome() is None:  # it may have arrived before the answer
                await self._expire(status)
        return await wait(stream)

    async def follow_again(self, error: ConnectionLost, lost: GoalStream) -> GoalStream:
        """Follow the accepted goal again, after the feedback that was read of a lost stream.

        Raises:
            GoalTimeout: The time is over.
            UnknownGoal: The server does not know the goal any more.
            ActionError: The error of the last attempt; `error` if there is no other attempt.
        """
        if not self._is_retried(error):
            raise error
        await self._pause(error, lost)
        stream = await self._reach(lambda: self._follow(lost), lost)
        if not lost.reads:
            stream.close()
        return stream

    async def give_up(self, *, unanswered: float = 0.0) -> None:
        """Cancel the goal, if it may run and was not canceled here before: see `cancel_left`."""
        if self._may_run and not self.is_given_up:
            self.is_given_up = True
            await cancel_left(self._endpoint, self._goal_id, unanswered=unanswered)

    # Attempts

    async def _reach(
        self, request: Callable[[], Awaitable[GoalStream]], lost: GoalStream | None
    ) -> GoalStream:
        """Make a request until the server has answered it with a stream."""
        while True:
            try:
                return await self._limit(request, lost)
            except ActionError as exc:
                if not self._is_retried(exc):
                    raise
                error = exc
            try:
                await self._pause(error, lost)
            finally:
                del error  # its traceback references this frame

    async def _send(self, request: GoalRequest) -> GoalStream:
        before, self._may_run = self._may_run, True
        start = current_time()
        try:
            offered = self._endpoint.offer_goal(request)
            return offered if isinstance(offered, GoalStream) else await offered
        except get_cancelled_exc_class():
            await self.give_up(unanswered=current_time() - start)
            raise
        except ConnectionLost:
            raise
        except ActionError:
            self._may_run = before
            raise

    async def _follow(self, lost: GoalStream) -> GoalStream:
        after = lost.cursor if lost.reads else None
        return await self._endpoint.feedback(
            self._goal_id, after=after, own=True, attempt=lost.attempt
        )

    def _is_retried(self, error: ActionError) -> bool:
        """Return whether there is another attempt after this error."""
        retry = self._retry
        return retry is not None and self._count < retry.attempts and retry.is_for(error)

    async def _pause(self, error: ActionError, lost: GoalStream | None) -> None:
        """Wait before the next attempt."""
        retry, self._error = self._retry, copy_of(error)  # without a traceback, which holds `self`
        assert retry is not None
        self._count += 1
        delay = retry.delay_before(self._count)
        logger.info(
            "goal %s: attempt %d of %d comes in %.2g s, because the last one failed: %s",
            self._goal_id,
            self._count,
            retry.attempts,
            delay,
            error,
        )
        try:
            await self._limit(lambda: self._sleep(delay), lost)
            if self._retry is None:
                raise error
        except get_cancelled_exc_class():
            await self.give_up()
            raise
        finally:
            del error  # the cancellation that ends the pause may reference this frame

    async def _sleep(self, seconds: float) -> None:
        """Wait so long, or until there are to be no more attempts."""
        with anyio.move_on_after(seconds):
            await self._stopped.wait()

    # Deadline

    async def _limit(self, wait: Callable[[], Awaitable[T]], lost: GoalStream | None) -> T:
        """Wait until the deadline at most."""
        if current_time() < self._deadline:
            with CancelScope(deadline=self._deadline):
                return await wait()
        return await self._expire(GoalStatus.UNKNOWN if lost is None else lost.status)

    async def _status_of(self, stream: GoalStream) -> GoalStatus:
        """Return the status of a goal that has not ended, as new as it can be known."""
        known = stream.status
        if stream.reads or known is not GoalStatus.ACCEPTED or self._expired is not None:
            return known
        with anyio.move_on_after(STATUS_TIMEOUT):
            try:
                with await self._endpoint.feedback(self._goal_id, own=True) as newer:
                    return max(known, newer.status)
            except ActionError:
                pass  # the cancel is answered with the same error, and logs it
        return known

    async def _expire(self, status: GoalStatus) -> NoReturn:
        """Cancel the goal, and raise `GoalTimeout`, which tells the status."""
        if self._expired is None:
            self._expired = GoalTimeout(
                f"it took longer than {self._timeout:g} s, and {self._progress(status)}",
                goal_id=self._goal_id,
                status=status,
                feedback=self._feedback,
                feedback_count=self._feedback_count,
            )
            await self.give_up()
        raise copy_of(self._expired) from self._error

    def _progress(self, status: GoalStatus) -> str:
        if status is GoalStatus.UNKNOWN:
            return "was not known to be accepted"
        if not self._feedback_count:
            return f"was {status.name}"
        messages = "message" if self._feedback_count == 1 else "messages"
        return f"was {status.name} after {self._feedback_count} feedback {messages}"

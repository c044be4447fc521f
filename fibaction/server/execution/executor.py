"""Runs one executor, a user's async generator, from its first step to its end.

Theory of operation
-------------------

An `Execution` iterates over the user's generator. A value of the feedback's type is encoded and
appended to the goal's log; a value of the result's type is kept as the result, and must be the last
one. Each feedback is a cancellation point, but the pause that makes it one is skipped if no
cancellation is pending, the log has room, and the executor has not yet used up its slice of time.
This makes goals that never wait cheap.

A cancellation that arrives in the pause is thrown into the generator at its `yield`, so the
executor sees it there as it would at any `await`. `interruption` makes it arrive once.

The end of the generator becomes an `Ending`:

- it returned after a result: RESULT;
- it raised the cancellation, or `GoalCanceled`: CANCELED, with the partial result, if any;
- it raised `GoalAborted`: FAILED, with the reason and the partial result;
- it raised another exception, or broke a rule of executors (`Misuse`): FAILED, with the error as
  the reason, and a traceback in the log `fibaction.server`.

An executor that is killed and does not end is given up (`_given_up`): nothing awaits it any more.
So that nothing closes its generator either, the event loop is not told of the generator (`_first`).

The registry turns an ending into a status of the goal. This module does not depend on the rules for
statuses, on clients or on other goals.
"""

from __future__ import annotations

import sys
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Coroutine
from contextvars import Context, copy_context
from functools import partial
from time import perf_counter
from types import AsyncGeneratorType
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar, cast

from anyio import get_cancelled_exc_class
from anyio.lowlevel import checkpoint

from fibaction._runtime.log import clean_logger
from fibaction.server.execution.executor_life import (
    EXECUTOR_LIFE,
    ExecutorEvent,
    ExecutorPhase,
    ScopesEvent,
)
from fibaction.server.execution.interruption import CancelOnce, Steps
from fibaction.server.execution.watchdog import Watch
from fibaction.server.execution.yielded_items import Misuse, a, is_feedback_message
from fibaction.server.goal_handle import GoalHandle
from fibaction.server.life import Phase
from fibaction.server.registry.goal_record import Ending, EndKind
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.words.current_goal import CurrentGoal, current_goal
from fibaction.words.errors import GoalAborted, GoalCanceled, text_of

if TYPE_CHECKING:
    from fibaction.feeds.feedback_log import FeedbackLog
    from fibaction.server.registry.goal_record import GoalRecord
    from fibaction.words.goals import GoalID

T = TypeVar("T")

logger = clean_logger("fibaction.server")


Executor: TypeAlias = Callable[[GoalHandle[GoalT]], AsyncIterator[FeedbackT | ResultT]]
"""An async generator function: it takes a goal, yields feedback, and yields the result last. Its
return type is written as `AsyncIterator[Feedback | Result]`, or as an `AsyncGenerator`."""


Fence: TypeAlias = Callable[["Execution[Any, Any, Any]"], bool]
"""A function that interrupts an executor, and returns True, if it may not take another step."""

# Looked up for each goal: a name of this module is found faster than a member of an enum.
PREPARED, INTERRUPTED = ExecutorPhase.PREPARED, ExecutorPhase.INTERRUPTED


class Execution(Generic[GoalT, FeedbackT, ResultT]):
    """One run of one goal's executor."""

    __slots__ = (
        "_action",
        "_context",
        "_current",
        "_executor",
        "_log",
        "_owner",
        "_result",
        "_scopes",
        "_stall_timeout",
        "_steps",
        "_watch",
        "fence",
        "goal",
        "handle",
        "phase",
    )

    def __init__(
        self,
        action: Action[GoalT, FeedbackT, ResultT],
        executor: Executor[GoalT, FeedbackT, ResultT],
        handle: GoalHandle[GoalT],
        log: FeedbackLog[GoalRecord],
        stall_timeout: float,
        watch: Watch,
        context: Context | None = None,
    ) -> None:
        self.handle = handle
        self.goal = log.goal
        """The record of the goal that it runs now."""
        self._action = action
        self._executor = executor
        self._log = log
        self._stall_timeout = stall_timeout
        self._watch = watch
        self._owner = log.goal.sender.owner
        self._result: bytes | None = None
        # The context variables of the call that sent the goal, as a task of its own would have.
        self._context = context or copy_context()
        self._current = CurrentGoal(action.name, self.goal.goal_id)
        self._context.run(current_goal.set, self._current)
        self.fence: Fence | None = None
        """The function that is asked before each step; None if the executor may always go on."""
        self.phase = PREPARED
        """The phase of the executor's life; it is gone with its clean-up. `Runs` says when."""
        self._scopes: CancelOnce | None = None
        self._steps: Steps[Ending]

    def run(self, scopes: CancelOnce) -> Awaitable[Ending]:
        """Run the executor to its end, and return its ending. To be called once."""
        self._scopes = scopes
        watch = self._watch
        self._steps = Steps(
            self._run(), scopes, self._context, self._given_up, self._spared, watch.current
        )
        watch.begin(self._steps, self)
        if self.phase is INTERRUPTED:
            self._steps.interrupt()
        return self._steps

    def interrupt(self) -> None:
        """Raise the backend's cancellation in the generator, once, at its current or next `await`
        or `yield`. Each `await` after that is clean-up, and is not canceled.
        """
        before = self.phase
        self.phase = EXECUTOR_LIFE[before, ExecutorEvent.INTERRUPT]
        if self.phase is not before and self._scopes is not None:
            self._steps.interrupt()

    def kill(self, *, for_good: bool = True) -> None:
        """Cancel every `await` from now on, those of the clean-up included, and discard feedback,
        since the goal has ended.

        An executor that survives this is given up if `for_good`; otherwise it runs on.
        """
        if self._scopes is not None:
            self._log = self._log.discarding()
            self._scopes.kill(for_good=for_good)

    def go_on_as(self, handle: GoalHandle[GoalT], log: FeedbackLog[GoalRecord]) -> None:
        """Give all that the executor yields from now on to another goal.

        Raises:
            RuntimeError: It has yielded a result already.
        """
        if self._result is not None:
            raise RuntimeError("take over a goal before the result of this one, not after it")
        self.handle, self.goal, self._log = handle, log.goal, log
        self._current.goal_id = log.goal.goal_id
        self._owner = log.goal.sender.owner

    async def _run(self) -> Ending:
        if self.fence is not None:
            self._steps.fence = partial(self.fence, self)
        try:
            try:
                items = self._start()
                try:
                    await self._consume(items)
                finally:
                    await items.aclose()
            except BaseException as exc:
                ending = self._ended_by(exc)
            else:
                ending = Ending(EndKind.RESULT, self._result)
                if self._result is None:
                    ending = self._failed(Misuse("it ended without yielding a result"))
            if self.handle.steps is not None:
                await self.handle.steps.settle(is_over=ending.kind is not EndKind.CANCELED)
            return ending
        finally:
            assert self._scopes is not None
            self._scopes.steps = None
            self._scopes = None
            self._watch.end(self._steps)
            del self._steps  # it and this object reference each other

    def _given_up(self) -> Ending:
        """Tell in the log that the executor runs no further, and return the ending for its goal."""
        self._scopes = None
        logger.error(
            "goal %s of action %r: its executor does not end though it was killed, and is"
            " abandoned; what it holds stays taken until this process ends",
            self.handle.goal_id,
            self._action.name,
        )
        return Ending(EndKind.FAILED, self._result, "the executor was abandoned")

    def _spared(self) -> None:
        """Tell in the log that the executor runs on."""
        logger.error(
            "goal %s of action %r: its executor does not end though it was killed, and runs on;"
            " its place in the schedule stays taken until then",
            self.handle.goal_id,
            self._action.name,
        )

    def _ended_by(self, exc: BaseException) -> Ending:
        # In a frame of its own: a traceback references its frames. If one of those also referenced
        # the exception, the cycle would keep the goal alive until the garbage collector runs.
        cause = _cause(exc)
        if cause is None:
            assert self._scopes is not None
            self._scopes.happen(ScopesEvent.INTERRUPT)  # the task itself may have been canceled
            return Ending(EndKind.CANCELED, self._result)
        if isinstance(cause, GoalCanceled):
            return self._part(EndKind.CANCELED, cause)
        if isinstance(cause, GoalAborted):
            return self._part(EndKind.FAILED, cause)
        if isinstance(cause, (KeyboardInterrupt, SystemExit)):
            raise exc
        return self._failed(cause)

    def _start(self) -> AsyncGenerator[FeedbackT | ResultT, None]:
        items: Any = self._executor(self.handle)
        # Most are of the first type, which is checked faster than the abstract class.
        if not isinstance(items, (AsyncGeneratorType, AsyncGenerator)):
            if isinstance(items, Coroutine):
                items.close()  # or Python warns that it was never awaited
            raise Misuse(f"it is not an async generator: it returned {a(cast('object', items))}")
        return cast("AsyncGenerator[FeedbackT | ResultT, None]", items)

    async def _consume(self, items: AsyncGenerator[FeedbackT | ResultT, None]) -> None:
        feedback, result, steps = self._action.feedback, self._action.result, self._steps
        step = _first(items)
        while True:
            try:
                item: Any = await step
            except StopAsyncIteration:
                return
            except BaseException:
                del step  # it may reference the exception, which references this frame
                raise
            if self._result is not None:
                raise Misuse(f"it yielded {a(item)} after its result")
            if feedback.holds(item) or (
                not result.holds(item) and is_feedback_message(item, self._action)
            ):
                log = self._log
                log.append(feedback.encode(item))
                if steps.pending or log.is_full or perf_counter() >= steps.slice_end:
                    try:
                        await self._pause()
                    except get_cancelled_exc_class() as exc:
                        # The cancellation arrives in this module, but belongs at the generator's
                        # `yield`: it may be this goal's cancel, or a timeout that the generator
                        # has set around that `yield`.
                        step = items.athrow(exc)
                        continue
            else:
                # The result is not a cancellation point, since the goal is done.
                self._result = result.encode(item)
            step = items.__anext__()

    async def _pause(self) -> None:
        assert self._scopes is not None
        if self._steps.pending or self._log.is_full:
            await checkpoint()
        else:  # its slice is over
            await self._scopes.turns.pause(self._owner)
        if self._log.is_full:
            await self._log.wait_for_room(self._stall_timeout)
            await self._scopes.turns.pause(self._owner)  # very many may be woken at once

    def _part(self, kind: EndKind, exc: GoalCanceled | GoalAborted) -> Ending:
        result = self._action.result
        if exc.result is None:
            return Ending(kind, self._result, exc.reason)
        if not result.accepts(exc.result):
            # Usually the error of another goal that the executor sent, and did not catch.
            left_out = f"its result is left out: {a(exc.result)} is not of the result's type"
            reason = f"{exc.reason} ({left_out})" if exc.reason else left_out
            self._log_failure(f"{type(exc).__name__}: {reason}", exc)
            return Ending(kind, self._result, reason)
        try:
            return Ending(kind, result.encode(exc.result), exc.reason)
        except Exception as bad:  # encoding runs the user's own code, which may raise anything
            return self._failed(bad)

    def _failed(self, exc: BaseException) -> Ending:
        reason = text_of(exc)
        if isinstance(exc, Misuse):
            reason = f"the executor is wrong: {exc}"
        self._log_failure(reason, exc)
        return Ending(EndKind.FAILED, self._result, reason)

    def _log_failure(self, reason: str, exc: BaseException) -> None:
        if self.goal.phase is Phase.LOST:
            return  # it was interrupted, and could not keep its checkpoint
        logger.error(
            "goal %s of action %r failed: %s",
            self.handle.goal_id,
            self._action.name,
            reason,
            exc_info=exc,
        )


def warn_of_kill(goal_id: GoalID, action: str, timeout: float) -> None:
    """Log that a goal is killed, which was interrupted `timeout` seconds ago."""
    logger.warning(
        "goal %s of action %r did not stop in time (%g s), and is killed", goal_id, action, timeout
    )


def _first(items: AsyncGenerator[T, None]) -> Awaitable[T]:
    """Begin the iteration, without the event loop's hooks.

    With them, the loop closes the generator at its own end. `Execution` closes it, so this would
    only reach one that was abandoned: it would run again, and keep the loop from ending.
    """
    hooks = sys.get_asyncgen_hooks()
    sys.set_asyncgen_hooks(None, None)
    try:
        return items.__anext__()
    finally:
        sys.set_asyncgen_hooks(*hooks)


def _cause(exc: BaseException) -> BaseException | None:
    """Return the error, out of any exception group around it; None if it is a cancellation."""
    canceled = get_cancelled_exc_class()
    if isinstance(exc, canceled):
        return None
    if not isinstance(exc, BaseExceptionGroup):
        return exc
    group = cast("BaseExceptionGroup[BaseException]", exc)
    rest = group.split(canceled)[1]
    if rest is None:
        return None
    first, *others = rest.exceptions
    return rest if others else _cause(first)

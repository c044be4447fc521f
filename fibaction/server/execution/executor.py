"""Runs one executor of a user, a generator or a function, from its first step to its end.

Theory of operation
-------------------

An executor has one of two forms, and a `Runner` runs those of one form: `Execution.iterate` async
generators, and `FunctionAction.run` functions. A runner is short. It hands feedback and the result
over to an `Execution`, and raises what the executor raises; all rules for an executor are here.

A value of the feedback's type is encoded and appended to the goal's log; a value of the result's
type is kept as the result, and must be the last one. Each feedback is a cancellation point, but the
pause that makes it one is skipped if no cancellation is pending, the log has room, and the executor
has not yet used up its slice of time. This makes goals that never wait cheap.

A cancellation that arrives in the pause is thrown into the generator at its `yield`, so the
executor sees it there as it would at any `await`. `interruption` makes it arrive once.

The end of the executor becomes an `Ending`:

- it returned after a result: RESULT;
- it raised the cancellation, or `GoalCanceled`: CANCELED, with the partial result, if any;
- it raised `GoalAborted`: FAILED, with the reason and the partial result;
- it raised another exception, or broke a rule of executors (`Misuse`): FAILED, with the error as
  the reason, and a traceback in the log `fibaction.server`. `SystemExit` is one of these, and
  `KeyboardInterrupt` is not.

An executor that is killed and does not end is given up (`_abandoned`): nothing awaits it any more.
So that nothing closes a generator either, the event loop is not told of it (`_first`).

The registry turns an ending into a status of the goal. This module does not depend on the rules for
statuses, on clients or on other goals.
"""

from __future__ import annotations

import sys
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Coroutine
from contextvars import Context, copy_context
from enum import IntEnum
from functools import partial
from time import perf_counter
from types import AsyncGeneratorType
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar, cast

from anyio import get_cancelled_exc_class
from anyio.lowlevel import checkpoint

from fibaction._runtime.log import clean_logger
from fibaction.server.execution.executor_ends import (
    GENERATOR,
    Misuse,
    cause_of,
    error_end,
    failed,
    is_feedback_message,
    kind_of,
    no_result,
    wrong_result,
)
from fibaction.server.execution.interruption import CancelOnce, ScopesPhase, Stepper
from fibaction.server.execution.watchdog import Watch
from fibaction.server.functions.report import RunningGoal
from fibaction.server.goal_handle import GoalHandle
from fibaction.server.registry.goal_record import Ending, EndKind
from fibaction.types.action import Action, Codec, FeedbackT, GoalT, ResultT
from fibaction.words.goals import CurrentGoal, current_goal
from fibaction.words.progress import Return

if TYPE_CHECKING:
    from fibaction.feeds.feedback_log import FeedbackLog
    from fibaction.server.registry.goal_record import GoalRecord
    from fibaction.words.errors import ConnectionLost
    from fibaction.words.goals import Outcome

T = TypeVar("T")

logger = clean_logger("fibaction.server")

Executor: TypeAlias = Callable[
    [GoalHandle[GoalT]], AsyncIterator[FeedbackT | ResultT | Return[ResultT]]
]
"""An async generator function: it takes a goal, yields feedback, and yields the result last. Its
return type is written as `AsyncIterator[Feedback | Result]`, or as an `AsyncGenerator`. `Return`
marks a result that could be feedback."""


Runner: TypeAlias = Callable[
    ["Execution[Any, Any, Any]", GoalHandle[Any]], Coroutine[Any, Any, None]
]
"""A coroutine function that runs a user's executor once, for the goal of an `Execution`."""

Fence: TypeAlias = Callable[["Execution[Any, Any, Any]"], bool]
"""A function that interrupts an executor, and returns True, if it may not take another step."""


class ExecutorPhase(IntEnum):
    """A phase of an executor's life, in the order in which they come."""

    PREPARED = 0
    """Its goal is accepted."""
    CALLED = 1
    """It runs, or begins soon: its goal has its turn."""
    INTERRUPTED = 2
    """By whatever came first; it may clean up."""
    GONE = 3


# Looked up for each goal: a name of this module is found faster than a member of an enum.
PREPARED, INTERRUPTED = ExecutorPhase.PREPARED, ExecutorPhase.INTERRUPTED


class Execution(RunningGoal, Generic[GoalT, FeedbackT, ResultT]):
    """One run of one goal's executor."""

    __slots__ = (
        "_action",
        "_context",
        "_current",
        "_log",
        "_owner",
        "_result",
        "_runner",
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
        runner: Runner,
        handle: GoalHandle[GoalT],
        log: FeedbackLog[GoalRecord],
        stall_timeout: float,
        watch: Watch,
        context: Context | None = None,
    ) -> None:
        self.home, self._waits = watch.home, ()
        self.handle = handle
        self.goal = log.goal
        """The record of the goal that it runs now."""
        self._action = action
        self._runner = runner
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
        """The function that is asked before each step; None if the executor may always continue."""
        self.phase = PREPARED
        """The phase of the executor's life; it is gone with its clean-up. `Runs` says when."""
        self._scopes: CancelOnce | None = None
        self._steps: Stepper[Ending]

    def run(self, scopes: CancelOnce) -> Awaitable[Ending]:
        """Run the executor to its end, and return its ending. To be called once."""
        self._scopes = scopes
        watch = self._watch
        self._steps = Stepper(
            self._run(), scopes, self._context, self._abandoned, self._spared, watch.current
        )
        watch.begin(self._steps, self)
        if self.phase is INTERRUPTED:
            self._steps.interrupt()
        return self._steps

    def interrupt(self) -> None:
        """Raise the backend's cancellation in the generator, once, at its current or next `await`
        or `yield`. Each `await` after that is clean-up, and is not canceled.
        """
        if self.phase < INTERRUPTED:
            self.phase = INTERRUPTED
            if self._scopes is not None:
                self._steps.interrupt()
                self.end_waits()

    def kill(self, *, for_good: bool = True) -> None:
        """Cancel every `await` from now on, those of the clean-up included, and discard feedback,
        since the goal has ended.

        An executor that survives this is given up if `for_good`; otherwise it keeps running.
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
        self.handle.running, handle.running = None, self
        self.handle, self.goal, self._log = handle, log.goal, log
        self._current.goal_id = log.goal.goal_id
        self._owner = log.goal.sender.owner

    async def _run(self) -> Ending:
        self.handle.running = self
        if self.fence is not None:
            self._steps.fence = partial(self.fence, self)
        try:
            try:
                await self._runner(self, self.handle)
            except BaseException as exc:
                ending = self._ended_by(exc)
            else:
                ending = Ending(EndKind.RESULT, self._result)
                if self._result is None:
                    error = no_result(self._action, self._log.count)
                    ending = failed(error, self._action, self.goal)
            if self.handle.steps is not None:
                await self.handle.steps.settle(is_over=ending.kind is not EndKind.CANCELED)
            return ending
        finally:
            assert self._scopes is not None
            self.handle.running = None
            self._scopes.steps = None
            self._scopes = None
            self._watch.end(self._steps)
            del self._steps  # it and this object reference each other

    def _abandoned(self) -> Ending:
        self._scopes = None
        self._tell_survival(
            "is abandoned; what it holds, such as files and locks, stays in use until this process"
            " ends"
        )
        return Ending(EndKind.FAILED, self._result, "it was abandoned, since it did not end")

    def _spared(self) -> None:
        self._tell_survival("runs on; its place in the schedule stays taken until then")

    def _tell_survival(self, what_follows: str) -> None:
        logger.error(
            "goal %s of action %r does not end though it was killed, and %s",
            self.handle.goal_id,
            self._action.name,
            what_follows,
        )

    def _ended_by(self, exc: BaseException) -> Ending:
        # In a frame of its own: a traceback references its frames. If one of those also referenced
        # the exception, the cycle would keep the goal alive until the garbage collector runs.
        cause = cause_of(exc)
        if cause is None:
            assert self._scopes is not None
            self._scopes.reach(ScopesPhase.SPENT)  # the task itself may have been canceled
            return Ending(EndKind.CANCELED, self._result)
        if isinstance(cause, KeyboardInterrupt):
            raise exc
        return error_end(cause, self._action, self.goal, self._result)

    async def iterate(
        self, goal: GoalHandle[GoalT], executor: Executor[GoalT, FeedbackT, ResultT]
    ) -> None:
        """Run an async generator function to its end: the `Runner` of generators."""
        feedback, result, steps = self._action.feedback, self._action.result, self._steps
        encode: Callable[[Any], bytes] = feedback.encode
        items = _generator_of(executor(goal))
        step = _first(items)
        try:
            while True:
                try:
                    item: Any = await step
                except StopAsyncIteration:
                    return
                except BaseException:
                    del step  # it may reference the exception, which references this frame
                    raise
                if self._result is not None:
                    raise Misuse(f"yielded {kind_of(item)} after its result")
                if isinstance(item, Return):
                    self.keep_result(cast("object", item.value))
                elif isinstance(item, feedback.classes) or (
                    not isinstance(item, result.classes) and is_feedback_message(item, self._action)
                ):
                    is_full = self._log.append(encode(item))
                    if is_full or steps.pending or perf_counter() >= steps.slice_end:
                        try:
                            await self._pause()
                        except get_cancelled_exc_class() as exc:
                            # The cancellation arrives in this module, but belongs at the
                            # generator's `yield`: it may be this goal's cancel, or a timeout that
                            # the generator has set around that `yield`.
                            step = items.athrow(exc)
                            continue
                else:
                    # The result is not a cancellation point, since the goal is done.
                    self._result = result.encode(item)
                step = items.__anext__()
        finally:
            await items.aclose()

    async def _pause(self) -> None:
        assert self._scopes is not None
        turns = self._scopes.turns  # the executor may end while others of its tasks are here
        if self._steps.pending or self._log.is_full:
            await checkpoint()
        else:  # its slice is over
            await turns.pause(self._owner)
        if self._log.is_full:
            await self._log.wait_for_room(self._stall_timeout)
            await turns.pause(self._owner)  # very many may be woken at once

    # What executors report without a `yield`: see `RunningGoal`

    @property
    def is_interrupted(self) -> bool:
        # It is gone with the end, which may come while another thread is here.
        steps, scopes = getattr(self, "_steps", None), self._scopes
        return steps is not None and (
            steps.pending or scopes is None or scopes.phase >= ScopesPhase.KILLED
        )

    def encode(self, feedback: object) -> bytes:
        codec = self._action.feedback
        if not codec.accepts(feedback):
            raise TypeError(
                f"feedback of action {self._action.name!r} is {codec.type_text}, and not"
                f" {kind_of(feedback)}"
            )
        return codec.encode(feedback)

    def keep_result(self, value: object, subject: str = GENERATOR) -> None:
        result = self._action.result
        if not result.accepts(value):
            raise wrong_result(value, self._action, subject)
        self._result = result.encode(value)

    def append(self, payload: bytes) -> bool:
        steps, is_full = self._steps, self._log.append(payload)
        return is_full or steps.pending or perf_counter() >= steps.slice_end

    def send(self, feedback: object) -> bool:
        # `encode` and `append` in one, since each message of most functions is here.
        codec: Codec[Any] = self._action.feedback
        steps = self._steps
        if not isinstance(feedback, codec.classes):
            return self.append(self.encode(feedback))
        is_full = self._log.append(codec.encode(feedback))
        return is_full or steps.pending or perf_counter() >= steps.slice_end

    async def pause(self) -> None:
        if self._scopes is not None:  # else it was abandoned, and its thread keeps running
            await self._pause()

    def arrive(self) -> None:
        self._steps.arrive()


class Run(Generic[GoalT, FeedbackT, ResultT]):
    """An active goal: its record, its log with the followers, and its executor."""

    __slots__ = ("error", "execution", "goal", "log", "outcome")

    def __init__(
        self,
        goal: GoalRecord,
        log: FeedbackLog[GoalRecord],
        execution: Execution[GoalT, FeedbackT, ResultT],
    ) -> None:
        self.goal = goal
        self.log = log
        self.execution = execution
        self.error: ConnectionLost | None = None
        """The error for the followers of a goal that leaves without an end."""
        self.outcome: Outcome[bytes] | None = None
        """The outcome once it is fixed; the goal's record has it once it is told."""


AnyRun: TypeAlias = Run[Any, Any, Any]


def _generator_of(items: Any) -> AsyncGenerator[Any, None]:
    """Return what an executor has returned, as the generator that it has to be."""
    # Most are of the first type, which is checked faster than the abstract class.
    if not isinstance(items, (AsyncGeneratorType, AsyncGenerator)):
        if isinstance(items, Coroutine):
            items.close()  # or Python warns that it was never awaited
        raise Misuse(f"is not an async generator: it returned {kind_of(cast('object', items))}")
    return cast("AsyncGenerator[Any, None]", items)


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

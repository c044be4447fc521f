"""Runs one executor, a user's async generator, from its first step to its end.

It hands over feedback as it is yielded, lets the generator be canceled wherever it is, and says in
the end how the generator left off. What that means for the goal is not decided here: this module
knows no rules on statuses, no clients and no other goals.
"""

from __future__ import annotations

import logging
import math
from collections.abc import AsyncGenerator, Awaitable, Callable, Coroutine, Generator
from contextvars import Context, copy_context
from time import perf_counter
from types import TracebackType
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, cast

from anyio import current_effective_deadline, get_cancelled_exc_class
from anyio.lowlevel import checkpoint

from fibaction.action import Action, FeedbackT, GoalT, ResultT
from fibaction.exceptions import GoalAborted, GoalCanceled, text_of
from fibaction.server._task_pool import SLICE, Life
from fibaction.server.registry import Ending, EndKind
from fibaction.states import GoalStatus

if TYPE_CHECKING:
    from fibaction.goals import GoalID
    from fibaction.server.feedback_log import FeedbackLog
    from fibaction.server.registry import Goal

logger = logging.getLogger("fibaction.server")


class GoalHandle(Generic[GoalT]):
    """What an executor knows of its goal."""

    __slots__ = ("_goal", "_server_stops", "request")

    def __init__(self, goal: Goal, request: GoalT, server_stops: Callable[[], bool]) -> None:
        self.request = request
        """The goal that the client sent."""
        self._goal = goal
        self._server_stops = server_stops

    @property
    def goal_id(self) -> GoalID:
        """The goal's name, made by the client."""
        return self._goal.goal_id

    @property
    def stamp(self) -> int:
        """When the goal was accepted: nanoseconds since 1970."""
        return self._goal.stamp

    @property
    def status(self) -> GoalStatus:
        """The goal's status now."""
        return self._goal.status

    @property
    def cancel_requested(self) -> bool:
        """Whether the goal is to stop: its cancel was accepted, or the server is stopping."""
        return self._goal.status is GoalStatus.CANCELING or self._server_stops()

    def __repr__(self) -> str:
        return f"<GoalHandle {self.goal_id} {self.status.name}>"


Executor: TypeAlias = Callable[[GoalHandle[GoalT]], AsyncGenerator[FeedbackT | ResultT, None]]
"""Takes a goal, yields feedback, and yields the result last."""


class Execution(Generic[GoalT, FeedbackT, ResultT]):
    """One goal's executor at work. `run` it once."""

    __slots__ = (
        "_action",
        "_context",
        "_executor",
        "_is_interrupted",
        "_life",
        "_log",
        "_result",
        "_stall_timeout",
        "_steps",
        "handle",
    )

    def __init__(
        self,
        action: Action[GoalT, FeedbackT, ResultT],
        executor: Executor[GoalT, FeedbackT, ResultT],
        handle: GoalHandle[GoalT],
        log: FeedbackLog,
        stall_timeout: float,
    ) -> None:
        self.handle = handle
        self._action = action
        self._executor = executor
        self._log = log
        self._stall_timeout = stall_timeout
        self._result: bytes | None = None
        # The variables of whoever sent the goal, as a task of its own would have them.
        self._context = copy_context()
        self._is_interrupted = False
        self._life: Life | None = None
        self._steps: _Steps

    def run(self, life: Life) -> Awaitable[Ending]:
        """Run the executor to its end, and say how it left off."""
        self._life = life
        self._steps = _Steps(self._run(), life, self._context)
        if self._is_interrupted:
            self._steps.interrupt()
        return self._steps

    def interrupt(self) -> None:
        """Raise the backend's cancellation inside the generator, once, where it is or next awaits
        or yields. What it awaits after that is its clean-up, and is left in peace.
        """
        if not self._is_interrupted:
            self._is_interrupted = True
            if self._life is not None:
                self._steps.interrupt()

    def kill(self) -> None:
        """End the clean-up too: from now on, whatever is awaited is canceled."""
        if self._life is not None:
            self._life.kill()

    async def _run(self) -> Ending:
        try:
            items = self._start()
            try:
                await self._consume(items)
            finally:
                await items.aclose()
        except BaseException as exc:
            return self._ended_by(exc)
        finally:
            self._life = None
            del self._steps  # it and this object hold each other
        if self._result is None:
            return self._failed(_Misuse("it ended without yielding a result"))
        return Ending(EndKind.RESULT, self._result)

    def _ended_by(self, exc: BaseException) -> Ending:
        # In a frame of its own: what goes wrong holds the frames that it came through, and one of
        # them that held it, too, would keep the whole goal until Python looks for such circles.
        cause = _cause(exc)
        if cause is None:
            assert self._life is not None
            self._life.is_spent = True  # somebody may have canceled the task itself
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
        if not isinstance(items, AsyncGenerator):
            if isinstance(items, Coroutine):
                items.close()  # or Python warns that nobody awaited it
            raise _Misuse(f"it is no async generator: it returned {_a(cast('object', items))}")
        return cast("AsyncGenerator[FeedbackT | ResultT, None]", items)

    async def _consume(self, items: AsyncGenerator[FeedbackT | ResultT, None]) -> None:
        feedback, result = self._action.feedback, self._action.result
        log, steps = self._log, self._steps
        step = items.__anext__()
        while True:
            try:
                item = await step
            except StopAsyncIteration:
                return
            except BaseException:
                del step  # it may hold what it has raised, and that holds this frame
                raise
            if self._result is not None:
                raise _Misuse(f"it yielded {_a(item)} after its result")
            if feedback.holds(item):
                log.append(feedback.encode(item))
                if steps.pending or log.is_full or perf_counter() >= steps.slice_end:
                    try:
                        await self._pause()
                    except get_cancelled_exc_class() as exc:
                        # Caught where this module waits, raised where the generator does: it may
                        # be this goal's cancel, or a timeout that the generator has set around
                        # its own `yield`.
                        step = items.athrow(exc)
                        continue
            elif result.holds(item):
                # The only yield that is no cancellation point: the goal is done.
                self._result = result.encode(item)
            else:
                raise _Misuse(f"it yielded {_a(item)}, which is neither feedback nor a result")
            step = items.__anext__()

    async def _pause(self) -> None:
        await checkpoint()
        if self._log.is_full:
            await self._log.wait_for_room(self._stall_timeout)

    def _part(self, kind: EndKind, exc: GoalCanceled | GoalAborted) -> Ending:
        result = self._action.result
        if exc.result is None:
            return Ending(kind, self._result, exc.reason)
        if not result.holds(exc.result):
            return self._failed(
                _Misuse(f"it raised {type(exc).__name__} with {_a(exc.result)} as its result")
            )
        try:
            return Ending(kind, result.encode(exc.result), exc.reason)
        except Exception as bad:  # encoding runs the user's own code, which may raise anything
            return self._failed(bad)

    def _failed(self, exc: BaseException) -> Ending:
        reason = text_of(exc)
        if isinstance(exc, _Misuse):
            reason = f"the executor is wrong: {exc}"
        logger.error(
            "goal %s of action %r is aborted: %s",
            self.handle.goal_id,
            self._action.name,
            reason,
            exc_info=exc,
        )
        return Ending(EndKind.FAILED, self._result, reason)


class _Misuse(Exception):
    """An executor that does not do what an executor does."""


class _Steps(Generator[Any, Any, Ending]):
    """Awaits a coroutine, and watches how it is resumed and suspended.

    So it knows how long the coroutine has gone on without awaiting, and sees a cancellation arrive.
    anyio and trio cancel by level: once a scope is canceled, every `await` in it raises. Here the
    first raises; as soon as the coroutine waits again, which is its clean-up, it is shielded.
    Inside a task group of the executor's own the backend's rule holds: the group is canceled with
    all that is in it, and clean-up there needs a shield. (On trio, a nursery that is open around
    clean-up keeps the cancellation to itself.)
    """

    __slots__ = (
        "_arrived",
        "_by_outcome",
        "_context",
        "_coroutine",
        "_life",
        "pending",
        "slice_end",
    )

    def __init__(
        self, coroutine: Coroutine[Any, Any, Ending], life: Life, context: Context
    ) -> None:
        self.pending = False
        """Whether an interruption is on its way and has not arrived."""
        self._coroutine = coroutine
        self._life = life
        self._context = context
        self._arrived = False
        self._by_outcome = False
        self.slice_end = 0.0
        """When the coroutine, if it has not waited until then, has gone on for too long."""

    def interrupt(self) -> None:
        """Cancel the coroutine, once."""
        self.pending = True
        self._life.interrupt()

    def __await__(self) -> Generator[Any, Any, Ending]:
        return self

    def __next__(self) -> Any:
        return self.send(None)

    def send(self, value: Any) -> Any:
        if value is not None:
            # trio resumes a task with an `outcome.Error`, and raises what is in it further inside.
            self._by_outcome = True
            self._look_at(getattr(value, "error", None))
        self.slice_end = perf_counter() + SLICE
        try:
            return self._suspend(self._context.run(self._coroutine.send, value))
        finally:
            del value  # see `throw`

    def throw(
        self,
        typ: type[BaseException] | BaseException,
        val: BaseException | object = None,
        tb: TracebackType | None = None,
    ) -> Any:
        # With one argument it is the exception itself; the other two are deprecated.
        assert isinstance(typ, BaseException)
        self._look_at(typ)
        self.slice_end = perf_counter() + SLICE
        # A bare cancellation, as of the task itself: a scope inside would take anyio's for its own.
        error = type(typ)() if self._arrived else typ
        try:
            return self._suspend(self._context.run(self._coroutine.throw, error))
        finally:
            # It holds the frames that it comes through, and they this one, since Python 3.12.
            del typ, error

    def close(self) -> None:
        self._coroutine.close()

    def _look_at(self, error: BaseException | None) -> None:
        if self.pending and isinstance(error, get_cancelled_exc_class()):
            self.pending = False
            self._arrived = True

    def _suspend(self, waiting_for: Any) -> Any:
        self._life.on_wait()
        if self._arrived:
            rest = self._life.rest
            rest.shield = True
            self._arrived = self._by_outcome and self._is_unwinding()
            rest.shield = not self._arrived
        return waiting_for

    def _is_unwinding(self) -> bool:
        """Whether what waits is, in all likelihood, a nursery that the cancellation passes on its
        way out. It must see that the cancellation comes from outside, or it would keep it.
        """
        return current_effective_deadline() == -math.inf and not self._life.rest.cancel_called


def _cause(exc: BaseException) -> BaseException | None:
    """What went wrong, out of any exception group around it; None if that is a cancellation."""
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


def _a(value: object) -> str:
    name = type(value).__qualname__
    return f"an {name}" if name[0] in "AEIOUaeiou" else f"a {name}"

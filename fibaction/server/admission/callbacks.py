"""Calls users' callbacks, so that each call ends as an acceptance or a rejection.

Theory of operation
-------------------

A callback accepts by returning None, and rejects by raising the rejection that belongs to it,
`GoalRejected` or `CancelRejected`. It may be sync or async. Every other outcome becomes a
rejection: another exception, a returned value, or a server that stops while the callback is
awaited.

`ask` returns None for a sync callback that accepts, so its caller needs no task; for an async one
it returns a coroutine to await. Each awaited callback runs in a cancel scope of its own, which
`stop` cancels.

A cancellation that comes out of a callback needs care. If the caller's own task or scope is
canceled, it must be passed on. Otherwise the callback awaited a task or future that was canceled
elsewhere, and this is an error of the callback like any other.

The caller of `GoalCallbacks` carries out the answers.
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Coroutine, Generator, Hashable
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar, TypeVarTuple

from anyio import CancelScope, current_effective_deadline, get_cancelled_exc_class

from fibaction._runtime.log import clean_logger
from fibaction._runtime.text import excerpt
from fibaction.border.event_loop import asyncio_task
from fibaction.server.admission.sender_argument import with_sender
from fibaction.types.action import GoalT
from fibaction.words.errors import (
    FAILURES,
    CancelRejected,
    GoalAborted,
    GoalRejected,
    RejectionCode,
    text_of,
)

if TYPE_CHECKING:
    from contextvars import Context

    from fibaction.server.goal_handle import GoalHandle
    from fibaction.server.settings import ActionServerSettings
    from fibaction.words.goals import GoalID, Sender

T = TypeVar("T")
Arguments = TypeVarTuple("Arguments")

_Rejection: TypeAlias = type[GoalRejected] | type[CancelRejected] | type[GoalAborted]

SERVER_STOPPING = "the server is stopping"
CANCELED_ELSEWHERE = "it awaited a task or future that was canceled elsewhere"

_running: ContextVar[tuple[tuple[object, str, Hashable], ...]] = ContextVar("_running", default=())
"""The async callbacks that this code is called by: of which server, its name, and about what."""

logger = clean_logger("fibaction.server")


class GoalCallbacks(Generic[GoalT]):
    """The decisions of a user on goals and cancels, asked for until the server stops; without a
    callback, each is accepted.
    """

    def __init__(self, action: str, settings: ActionServerSettings[GoalT]) -> None:
        """Make the callbacks of an action from the settings.

        Raises:
            TypeError: `on_goal` takes neither one argument nor two.
        """
        on_goal = settings.on_goal
        self._on_goal = None if on_goal is None else with_sender("on_goal", on_goal)
        self._on_cancel = settings.on_cancel
        self.are_goals_decided = on_goal is not None
        """True if a goal may be rejected."""
        self.are_cancels_decided = settings.on_cancel is not None
        """True if a cancel may be rejected."""
        self._action = action
        self._waiting: set[CancelScope] = set()

    def stop(self) -> None:
        """Cancel all callbacks that are awaited now; each counts as a rejection."""
        for scope in tuple(self._waiting):
            scope.cancel()

    def ask_goal(
        self, request: GoalT, sender: Sender, goal_id: GoalID, context: Context | None
    ) -> Coroutine[Any, Any, None] | None:
        """Call `on_goal`: return None if it accepts, or a coroutine that waits for its answer.

        Raises:
            GoalRejected: It rejects the goal, or has failed, here or in the coroutine.
        """
        on_goal, ask = self._on_goal, self.ask
        assert on_goal is not None  # else no goal is decided
        asked = (request, sender)
        if context is None:
            return ask("on_goal", on_goal, asked, GoalRejected, goal_id)
        return context.run(ask, "on_goal", on_goal, asked, GoalRejected, goal_id)

    def ask_cancel(self, handle: GoalHandle[GoalT]) -> Coroutine[Any, Any, None] | None:
        """Call `on_cancel`, in the same way.

        Raises:
            CancelRejected: It rejects the cancel, or has failed, here or in the coroutine.
            RuntimeError: `on_cancel` itself cancels the goal that it decides upon.
        """
        on_cancel, goal_id = self._on_cancel, handle.goal_id
        assert on_cancel is not None  # else no cancel is decided
        self._check_not_within("on_cancel", goal_id, "cancels")
        return self.ask("on_cancel", on_cancel, (handle,), CancelRejected, about=goal_id)

    def check_not_deciding(self, goal_id: GoalID) -> None:
        """Raise RuntimeError if this is called by the `on_goal` that decides on that goal: it would
        wait for itself.
        """
        self._check_not_within("on_goal", goal_id, "cancels, or sends again,")

    def ask(
        self,
        name: str,
        callback: Callable[[*Arguments], Awaitable[None] | None],
        arguments: tuple[*Arguments],
        rejection: _Rejection,
        about: Hashable = None,
    ) -> Coroutine[Any, Any, None] | None:
        """Call the callback of that name about a goal; return None if it accepts, or a coroutine
        that waits for its answer.

        Raises:
            GoalRejected, CancelRejected: The type is that of `rejection`, here or in the coroutine:
                the callback raised it, failed, or returned a value, or the server is stopping.
        """
        with failures_as(rejection, name, self._action):
            answer: object = _called(callback, arguments)
            if isinstance(answer, Awaitable):
                # Added here, so that `stop` reaches it even before the coroutine begins.
                scope = CancelScope()
                self._waiting.add(scope)
                return self._wait(scope, name, answer, rejection, about)
            _check(name, answer, rejection)
        return None

    def _check_not_within(self, name: str, about: Hashable, act: str) -> None:
        """Raise an error if this is called by an async callback of that name about that goal.

        A caller that waits for the answer of a callback calls this. If it were the callback itself,
        it would wait forever.

        Raises:
            RuntimeError: It is called by that callback, or by a task that the callback has started.
        """
        if (self, name, about) in _running.get():
            raise RuntimeError(
                f"{name} {act} the goal that it decides upon, and would wait for itself: do it"
                f" after {name} has returned"
            )

    async def _wait(
        self,
        scope: CancelScope,
        name: str,
        awaitable: Awaitable[object],
        rejection: _Rejection,
        about: Hashable,
    ) -> None:
        token = _running.set((*_running.get(), (self, name, about)))
        try:
            with failures_as(rejection, name, self._action):
                if scope.cancel_called:  # stopped before this coroutine began
                    if isinstance(awaitable, Coroutine):
                        awaitable.close()
                    raise _rejected(rejection, SERVER_STOPPING, RejectionCode.STOPPING)
                with scope:
                    _check(name, await awaited(awaitable), rejection)
                if scope.cancelled_caught:
                    raise _rejected(rejection, SERVER_STOPPING, RejectionCode.STOPPING)
        finally:
            self._waiting.discard(scope)
            _running.reset(token)


@contextmanager
def failures_as(rejection: _Rejection, name: str, action: str) -> Generator[None, None, None]:
    """Raise the rejection, and log the failure, if the block raises another exception.

    The block calls the function of that name, which a user has written for the action.
    """
    try:
        yield
    except rejection:
        raise
    except FAILURES as exc:
        reason = f"{name} failed: {text_of(exc)}"
        logger.error("action %r: %s", action, reason, exc_info=exc)
        raise _rejected(rejection, reason, RejectionCode.FAILED) from exc


def _rejected(rejection: _Rejection, reason: str, code: RejectionCode) -> Exception:
    return GoalRejected(reason, code=code) if rejection is GoalRejected else rejection(reason)


def _check(name: str, answer: object, rejection: _Rejection) -> None:
    if answer is not None:
        raise TypeError(
            f"{name} returned {excerpt(repr(answer))}: return None to accept,"
            f" raise {rejection.__name__}(reason) to reject"
        )


def _called(
    callback: Callable[[*Arguments], Awaitable[None] | None],
    arguments: tuple[*Arguments],
) -> Awaitable[None] | None:
    try:
        return callback(*arguments)
    except get_cancelled_exc_class() as exc:  # nothing was awaited, so it is not the caller's
        raise RuntimeError(CANCELED_ELSEWHERE) from exc


async def awaited(awaitable: Awaitable[object]) -> object:
    """Return what a function of the user returns in the end.

    Raises:
        RuntimeError: It has awaited something that was canceled elsewhere.
    """
    try:
        return await awaitable
    except get_cancelled_exc_class() as exc:
        if current_effective_deadline() == -math.inf or _is_canceled():
            raise
        raise RuntimeError(CANCELED_ELSEWHERE) from exc


def _is_canceled() -> bool:
    """Return whether this task itself was canceled, outside of scopes, as only asyncio can do."""
    task = asyncio_task()
    return task is not None and task.cancelling() > 0

"""Asks a user's callback, and makes sure that there is an answer: whatever it does, yes or no.

It knows nothing of goals; what yes and no mean is its caller's affair.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Awaitable, Callable, Coroutine, Generator
from contextlib import contextmanager
from typing import Any, TypeAlias, TypeVar

from anyio import CancelScope, current_effective_deadline, get_cancelled_exc_class

from fibaction.exceptions import CancelRejected, GoalRejected, text_of

T = TypeVar("T")
Callback: TypeAlias = Callable[[T], Awaitable[None] | None]
"""Sync or async; returns None to agree, raises the refusal to refuse."""

SERVER_STOPPING = "the server is stopping"
CANCELED_ELSEWHERE = "what it waits for was canceled by somebody else"

logger = logging.getLogger("fibaction.server")


class Callbacks:
    """Asks callbacks on behalf of one server, until that stops."""

    def __init__(self, action: str) -> None:
        self._action = action
        self._waiting: set[CancelScope] = set()

    def stop(self) -> None:
        """Wait for no callback any longer: those that are under way count as a refusal."""
        for scope in tuple(self._waiting):
            scope.cancel()

    def ask(
        self,
        name: str,
        callback: Callback[T],
        argument: T,
        refusal: type[GoalRejected] | type[CancelRejected],
    ) -> Coroutine[Any, Any, None] | None:
        """Call the callback of that name, and return None if it agrees; if it has to be waited for,
        a coroutine that does.

        Raises:
            GoalRejected, CancelRejected: Whichever is `refusal`, here or by the coroutine: the
                callback raised it, or failed, or returned something, or the server stopped
                meanwhile.
        """
        with self._refusing(name, refusal):
            answer: object = _called(callback, argument)
            if isinstance(answer, Awaitable):
                # From now on, and not only when the coroutine begins, `stop` is to reach it.
                scope = CancelScope()
                self._waiting.add(scope)
                return self._wait(scope, name, answer, refusal)
            _check(name, answer, refusal)
        return None

    async def _wait(
        self,
        scope: CancelScope,
        name: str,
        awaitable: Awaitable[object],
        refusal: type[GoalRejected] | type[CancelRejected],
    ) -> None:
        try:
            with self._refusing(name, refusal):
                if scope.cancel_called:  # before anybody has waited
                    if isinstance(awaitable, Coroutine):
                        awaitable.close()
                    raise refusal(SERVER_STOPPING)
                with scope:
                    _check(name, await _awaited(awaitable), refusal)
                if scope.cancelled_caught:
                    raise refusal(SERVER_STOPPING)
        finally:
            self._waiting.discard(scope)

    @contextmanager
    def _refusing(
        self, name: str, refusal: type[GoalRejected] | type[CancelRejected]
    ) -> Generator[None, None, None]:
        try:
            yield
        except refusal:
            raise
        except Exception as exc:
            reason = f"{name} failed: {text_of(exc)}"
            logger.error("action %r: %s", self._action, reason, exc_info=exc)
            raise refusal(reason) from exc


def _check(name: str, answer: object, refusal: type[GoalRejected] | type[CancelRejected]) -> None:
    if answer is not None:
        raise TypeError(
            f"{name} returned {answer!r}: return None to agree,"
            f" raise {refusal.__name__}(reason) to refuse"
        )


def _called(callback: Callback[T], argument: T) -> Awaitable[None] | None:
    try:
        return callback(argument)
    except get_cancelled_exc_class() as exc:  # nothing has been awaited, so it is of its own making
        raise RuntimeError(CANCELED_ELSEWHERE) from exc


async def _awaited(awaitable: Awaitable[object]) -> object:
    try:
        return await awaitable
    except get_cancelled_exc_class() as exc:
        if current_effective_deadline() == -math.inf or _is_canceled():
            raise
        raise RuntimeError(CANCELED_ELSEWHERE) from exc


def _is_canceled() -> bool:
    """Whether somebody has canceled this task itself, which of the backends only asyncio can do."""
    import asyncio  # noqa: TID251  # anyio does not tell

    try:
        task = asyncio.current_task()
    except RuntimeError:  # there is no loop of asyncio's: it is trio, and not as a guest
        return False
    return task is not None and task.cancelling() > 0

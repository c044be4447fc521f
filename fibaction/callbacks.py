"""Asks a user's callback, and makes sure that there is an answer: whatever it does, yes or no.

It knows nothing of goals; what yes and no mean is its caller's affair.
"""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable
from typing import TypeAlias, TypeVar

from anyio import CancelScope

from fibaction.exceptions import CancelRejected, GoalRejected

T = TypeVar("T")
Callback: TypeAlias = Callable[[T], Awaitable[None] | None]
"""Sync or async; returns None to agree, raises the refusal to refuse."""

SERVER_STOPPING = "the server is stopping"

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

    async def ask(
        self,
        name: str,
        callback: Callback[T],
        argument: T,
        refusal: type[GoalRejected] | type[CancelRejected],
    ) -> None:
        """Call the callback of that name, and return if it agrees.

        Raises:
            GoalRejected, CancelRejected: Whichever is `refusal`: the callback raised it, or failed,
                or returned something, or the server stopped meanwhile.
        """
        try:
            answer: object = callback(argument)
            if isinstance(answer, Awaitable):
                answer = await self._wait(answer, refusal)
            if answer is not None:
                raise TypeError(
                    f"{name} returned {answer!r}: return None to agree,"
                    f" raise {refusal.__name__}(reason) to refuse"
                )
        except refusal:
            raise
        except Exception as exc:
            reason = f"{name} failed: {type(exc).__name__}: {exc}"
            logger.error("action %r: %s", self._action, reason, exc_info=exc)
            raise refusal(reason) from exc

    async def _wait(
        self, answer: Awaitable[object], refusal: type[GoalRejected] | type[CancelRejected]
    ) -> object:
        with CancelScope() as scope:
            self._waiting.add(scope)
            try:
                return await answer
            finally:
                self._waiting.discard(scope)
        raise refusal(SERVER_STOPPING)

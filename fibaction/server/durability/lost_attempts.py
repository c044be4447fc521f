"""`LostAttempts`: what becomes of goals whose attempt was lost with its process."""

from __future__ import annotations

from collections.abc import Awaitable
from typing import TYPE_CHECKING, Generic

from fibaction._runtime.text import excerpt
from fibaction.border.goal_store import StoredGoal
from fibaction.server.admission.callbacks import awaited, failures_as
from fibaction.server.goal_handle import GoalHandle
from fibaction.server.registry.goal_record import Ending, EndKind
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.words.errors import GoalAborted

if TYPE_CHECKING:
    from fibaction.server.settings import ActionServerSettings

RESTARTED = "the server was restarted"


def cause_of(stored: StoredGoal) -> str:
    """Return the cause by which an attempt was lost."""
    return f"the worker {excerpt(stored.worker)!r} was lost" if stored.worker else RESTARTED


class LostAttempts(Generic[GoalT, FeedbackT, ResultT]):
    """The rule for goals whose attempt was lost: `recovery` and `max_attempts` of one server."""

    def __init__(
        self,
        action: Action[GoalT, FeedbackT, ResultT],
        settings: ActionServerSettings[GoalT],
    ) -> None:
        self._action = action
        self._max_attempts = settings.max_attempts
        self._reruns = settings.recovery != "abort"
        self._function = None if isinstance(settings.recovery, str) else settings.recovery

    @property
    def asks(self) -> bool:
        """True if a function of the user decides about goals that do not end in any case."""
        return self._function is not None

    def reason_to_end(self, stored: StoredGoal) -> str:
        """Return why a goal ends after another lost attempt; empty if it does not end."""
        lost = stored.lost + 1
        if not self._reruns:
            return cause_of(stored)
        if lost < self._max_attempts:
            return ""
        attempts = "1 attempt" if lost == 1 else f"{lost} attempts"
        return f"given up after {attempts}: {cause_of(stored)}"

    async def answer(self, handle: GoalHandle[GoalT]) -> Ending | None:
        """Ask the function about a goal, and return the goal's end; None if it is to run again."""
        try:
            with failures_as(GoalAborted, "recovery", self._action.name):
                return await self._ask(handle)
        except GoalAborted as failure:
            return Ending(EndKind.FAILED, reason=failure.reason)

    async def _ask(self, handle: GoalHandle[GoalT]) -> Ending | None:
        assert self._function is not None
        try:
            answer: object = self._function(handle)
            if isinstance(answer, Awaitable):
                answer = await awaited(answer)
        except GoalAborted as exc:
            return self._aborted(exc)
        if answer is not None:
            raise TypeError(f"it returned {answer!r}: return None, or raise GoalAborted")
        return None

    def _aborted(self, exc: GoalAborted) -> Ending:
        result = self._action.result
        if exc.result is None:
            return Ending(EndKind.FAILED, reason=exc.reason)
        if not result.accepts(exc.result):
            raise TypeError(f"{exc.result!r} is not of the result's type")
        return Ending(EndKind.FAILED, result.encode(exc.result), exc.reason)

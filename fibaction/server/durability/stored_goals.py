"""The rules about stored goals: which lost attempts are followed by another, `LostAttempts`, and
which goals this version can read, `ReadableCheck`.

For example, a new version has a required field that the goals in the store do not have. If they
were ended, going back to the old version would not bring them back. So the check comes before
anything is written or run. Where several servers share a store, it comes before this server takes
a goal, and another one can have it.
"""

from __future__ import annotations

from collections.abc import Awaitable, Iterable
from typing import TYPE_CHECKING, Generic

from fibaction._runtime.text import excerpt
from fibaction.border.event_loop import Slices
from fibaction.border.goal_store import StoredGoal
from fibaction.server.admission.callbacks import awaited, failures_as
from fibaction.server.durability.keeper import Checkpoints
from fibaction.server.goal_handle import GoalHandle
from fibaction.server.registry.goal_record import Ending, EndKind
from fibaction.server.scheduling.dispatcher import Dispatcher
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.words.errors import GoalAborted, ProtocolError, StoreError
from fibaction.words.goals import GoalID
from fibaction.words.statuses import GoalStatus

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
            raise TypeError(f"its result is {result.type_text}, not {exc.result!r}")
        return Ending(EndKind.FAILED, result.encode(exc.result), exc.reason)


NAMED = 3
"""The goals whose IDs are in the error."""


class ReadableCheck(Generic[GoalT, FeedbackT, ResultT]):
    """The check of the goals of one action, before its server starts."""

    def __init__(
        self,
        action: Action[GoalT, FeedbackT, ResultT],
        checkpoints: Checkpoints,
        dispatcher: Dispatcher[GoalT],
        lost_attempts: LostAttempts[GoalT, FeedbackT, ResultT],
        *,
        refuses: bool,
    ) -> None:
        self._action = action
        self._checkpoints = checkpoints
        self._dispatcher = dispatcher
        self._lost_attempts = lost_attempts
        self._refuses = refuses

    async def check(self, goals: Iterable[StoredGoal]) -> None:
        """Check that all goals that are to run can be read.

        Raises:
            StoreError: Some cannot be read, and the server is to refuse them.
        """
        if not self._refuses:
            return
        slices = Slices()
        failures: dict[GoalID, str] = {}
        for stored in goals:
            if self._is_to_run(stored) and (reason := self._failure_of(stored)):
                failures[GoalID(stored.goal_id)] = reason
            await slices.pause()
        if failures:
            raise self._error(failures)

    def obstacle(self, stored: StoredGoal) -> str:
        """Return why this server cannot run a goal; empty if it can.

        A goal whose cancel was accepted is not run again, so any server can end it.
        """
        return "" if stored.status is GoalStatus.CANCELING else self._failure_of(stored)

    def _is_to_run(self, stored: StoredGoal) -> bool:
        """Return False for a goal that has ended, or that ends in any case."""
        if stored.status.is_terminal or stored.status is GoalStatus.CANCELING:
            return False
        return not (stored.is_running and self._lost_attempts.reason_to_end(stored))

    def _failure_of(self, stored: StoredGoal) -> str:
        """Return why a goal cannot run; empty if it can."""
        try:
            request = self._action.goal.decode(stored.goal)
            self._checkpoints.restored(stored)
        except ProtocolError as exc:
            return str(exc)
        return self._dispatcher.failure_of(request, stored.sender)

    def _error(self, failures: dict[GoalID, str]) -> StoreError:
        named = ", ".join(map(str, list(failures)[:NAMED]))
        goals = "1 goal" if len(failures) == 1 else f"{len(failures):,} goals"
        more = ", and others" if len(failures) > NAMED else ""
        reason = excerpt(next(iter(failures.values())), 400)
        return StoreError(
            f"the store has {goals} that this version of action {self._action.name!r} cannot read"
            f" ({named}{more}): {reason}; nothing was changed: start the version that accepted"
            f" them, or end them as ABORTED with unreadable='abort'"
        )

"""The rules about stored goals: which lost attempts are followed by another, `LostAttempts`, and
which goals this version can read, `ReadableCheck`; and `PastGoals`, those that a server has
forgotten, and that its store has in its history.

For example, a new version has a required field that the goals in the store do not have. If they
were ended, going back to the old version would not bring them back. So the check comes before
anything is written or run. Where several servers share a store, it comes before this server takes
a goal, and another one can have it.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Generator, Iterable
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Generic

from fibaction._runtime.log import clean_logger
from fibaction._runtime.text import excerpt
from fibaction.border.byte_budgets import ByteBudget, CountedBytes
from fibaction.border.event_loop import Slices
from fibaction.border.goal_store import StoredGoal, checkpoint_to_tell
from fibaction.feeds.feedback_log import FeedbackCursor, FeedbackLog
from fibaction.feeds.followed_goal import GoalFacts
from fibaction.server.admission.callbacks import awaited, failures_as
from fibaction.server.durability.keeper import Keeper
from fibaction.server.goal_handle import GoalHandle
from fibaction.server.goal_logs import GoalLogs
from fibaction.server.registry.goal_record import Ending, EndKind
from fibaction.server.scheduling.dispatcher import Dispatcher
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.words.errors import (
    GoalAborted,
    LimitReached,
    ProtocolError,
    ServerFailed,
    StoreError,
    UnknownGoal,
)
from fibaction.words.goal_query import GoalQuery, PastPage
from fibaction.words.goals import GoalID, GoalInfo
from fibaction.words.statuses import GoalStatus

if TYPE_CHECKING:
    from fibaction.server.settings import ActionServerSettings

RESTARTED = "the server was restarted"
MOST_NAMED = 3
"""The goals whose IDs are in the error."""
logger = clean_logger("fibaction.server")


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


class ReadableCheck(Generic[GoalT, FeedbackT, ResultT]):
    """The check of the goals of one action, before its server starts."""

    def __init__(
        self,
        action: Action[GoalT, FeedbackT, ResultT],
        keeper: Keeper,
        dispatcher: Dispatcher[GoalT],
        lost_attempts: LostAttempts[GoalT, FeedbackT, ResultT],
        *,
        refuses: bool,
    ) -> None:
        self._action = action
        self._keeper = keeper
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
            self._keeper.restored(stored)
        except ProtocolError as exc:
            return str(exc)
        return self._dispatcher.failure_of(request, stored.sender)

    def _error(self, failures: dict[GoalID, str]) -> StoreError:
        named = ", ".join(map(str, list(failures)[:MOST_NAMED]))
        goals = "1 goal" if len(failures) == 1 else f"{len(failures):,} goals"
        more = ", and others" if len(failures) > MOST_NAMED else ""
        reason = excerpt(next(iter(failures.values())), 400)
        return StoreError(
            f"the store has {goals} that this version of action {self._action.name!r} cannot read"
            f" ({named}{more}): {reason}; nothing was changed: start the version that accepted"
            f" them, or end them as ABORTED with unreadable='abort'"
        )


class PastGoals:
    """The goals of the past of one server, for its clients."""

    def __init__(self, action: str, keeper: Keeper, logs: GoalLogs, budget: ByteBudget) -> None:
        """Count the bytes of a goal that is read in the budget, as long as it is followed."""
        self._action = action
        self._keeper = keeper
        self._logs = logs
        self._budget = budget

    async def page(self, page: PastPage) -> list[GoalInfo]:
        """See `Endpoint.past_goals`.

        Raises:
            ServerFailed: The history cannot be read.
        """
        with self._reading():
            return await self._keeper.past.past_goals(page)

    async def read(self, wanted: GoalQuery, take: Callable[[list[GoalInfo]], None]) -> None:
        """See `Endpoint.read_past`.

        Raises:
            ServerFailed: The history cannot be read.
        """
        with self._reading():
            await self._keeper.past.read_past(wanted, take)

    async def follow(
        self, goal_id: GoalID, *, own: bool, after: int | None, attempt: int
    ) -> FeedbackCursor:
        """Return a stream of a goal that the server remembers, or else of one of the past, which
        begins with its outcome. Who reads a goal from its beginning after its end gets its payload,
        too, if the history has it. One that was given up has its checkpoint.

        Raises:
            UnknownGoal: It is neither.
            LimitReached: There is no room for the bytes of a goal of the past.
            ServerFailed: The history cannot be read.
        """
        try:
            cursor = self._logs.follow(goal_id, own=own, after=after, attempt=attempt)
            if not self._budget.is_over:
                await self._tell_rest(cursor, from_beginning=after is not None)
            return cursor
        except UnknownGoal:
            kept = await self._given_up(goal_id)
            past = kept or await self._find(goal_id)
            if past is None:
                raise
        if self._budget.is_over:
            raise LimitReached("the server holds too many bytes to read a goal of the past")
        log = FeedbackLog(self._facts(past), payload=past.goal)
        cursor = log.follow(own=own, after=after, attempt=attempt)
        cursor.checkpoint = checkpoint_to_tell(kept)
        return cursor

    async def _tell_rest(self, cursor: FeedbackCursor, *, from_beginning: bool) -> None:
        """Add what the store has of a goal whose end is remembered, and can be told without it."""
        past: StoredGoal | None = None
        with suppress(ServerFailed):
            if self._logs.is_given_up(cursor.goal_id):
                past = await self._given_up(cursor.goal_id)
                cursor.checkpoint = checkpoint_to_tell(past)
            if past is None and cursor.goal is None and from_beginning:
                past = await self._find(cursor.goal_id)
        if past is not None and from_beginning:
            cursor.past_goal = past.goal
        if size := len(cursor.past_goal or b"") + len(cursor.checkpoint or b""):
            cursor.past_held = CountedBytes(self._budget, size)

    async def rerun(self, goal_id: GoalID) -> GoalID | None:
        """See `Endpoint.rerun`.

        Raises:
            ServerFailed: The new goal cannot be kept.
        """
        try:
            new = await self._keeper.past.rerun(goal_id)
        except StoreError as exc:
            logger.error("goal %s of %r cannot be run again: %s", goal_id, self._action, exc)
            raise ServerFailed("the server cannot keep that the goal runs again") from exc
        if new is not None:
            logger.warning("goal %s of %r runs again as goal %s", goal_id, self._action, new)
        return new

    async def _find(self, goal_id: GoalID) -> StoredGoal | None:
        with self._reading():
            return await self._keeper.past.past_goal(goal_id)

    async def _given_up(self, goal_id: GoalID) -> StoredGoal | None:
        with self._reading():
            return await self._keeper.past.given_up(goal_id)

    def _facts(self, past: StoredGoal) -> GoalFacts:
        facts = GoalFacts(GoalID(past.goal_id), past.stamp)
        facts.told_info = past.info
        facts.attempt = max(past.attempt, 1)
        facts.feedback_count = past.feedback_count
        facts.told_status = past.status
        facts.outcome = past.outcome
        size = len(past.goal) + len(past.checkpoint or b"") + facts.outcome.size
        facts.held = CountedBytes(self._budget, size)
        return facts

    @contextmanager
    def _reading(self) -> Generator[None, None, None]:
        """Log and hide an error of the store in the block.

        Raises:
            ServerFailed: The history cannot be read.
        """
        try:
            yield
        except StoreError as exc:
            logger.error("the history of action server %r cannot be read: %s", self._action, exc)
            raise ServerFailed("the server cannot read the history of its goals") from exc

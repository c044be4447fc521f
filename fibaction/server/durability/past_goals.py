"""`PastGoals`: the goals that a server has forgotten, and that its store has in its history."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from fibaction._runtime.log import clean_logger
from fibaction.border.byte_budgets import ByteBudget, CountedBytes
from fibaction.border.goal_store import StoredGoal
from fibaction.feeds.feedback_log import FeedbackCursor, FeedbackLog
from fibaction.feeds.followed_goal import GoalFacts
from fibaction.server.durability.keeper import Keeper
from fibaction.server.goal_logs import GoalLogs
from fibaction.words.errors import LimitReached, ServerFailed, StoreError, UnknownGoal
from fibaction.words.goal_query import GoalQuery, PastPage
from fibaction.words.goals import GoalID, GoalInfo

HISTORY_FAILED = "the server cannot read the history of its goals"

logger = clean_logger("fibaction.server")


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
        try:
            return await self._keeper.past.past_goals(page)
        except StoreError as exc:
            raise self._failure(exc) from exc

    async def read(self, wanted: GoalQuery, take: Callable[[list[GoalInfo]], None]) -> None:
        """See `Endpoint.read_past`.

        Raises:
            ServerFailed: The history cannot be read.
        """
        try:
            await self._keeper.past.read_past(wanted, take)
        except StoreError as exc:
            raise self._failure(exc) from exc

    async def follow(
        self, goal_id: GoalID, *, own: bool, after: int | None, attempt: int
    ) -> FeedbackCursor:
        """Return a stream of a goal that the server remembers, or else of one of the past, which
        begins with its outcome. Who reads a goal from its beginning after its end gets its payload,
        too, if the history has it.

        Raises:
            UnknownGoal: It is neither.
            LimitReached: There is no room for the bytes of a goal of the past.
            ServerFailed: The history cannot be read.
        """
        try:
            cursor = self._logs.follow(goal_id, own=own, after=after, attempt=attempt)
            if cursor.goal is None and after is not None and not self._budget.is_over:
                with suppress(ServerFailed):  # the rest of the goal is remembered
                    past = await self._find(goal_id)
                    cursor.past_goal = None if past is None else past.goal
            return cursor
        except UnknownGoal:
            past = await self._find(goal_id)
            if past is None:
                raise
        if self._budget.is_over:
            raise LimitReached("the server holds too many bytes to read a goal of the past")
        log = FeedbackLog(self._facts(past), payload=past.goal)
        return log.follow(own=own, after=after, attempt=attempt)

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
        try:
            return await self._keeper.past.past_goal(goal_id)
        except StoreError as exc:
            raise self._failure(exc) from exc

    def _facts(self, past: StoredGoal) -> GoalFacts:
        facts = GoalFacts(GoalID(past.goal_id), past.stamp)
        facts.told_info = past.info
        facts.attempt = max(past.attempt, 1)
        facts.feedback_count = past.feedback_count
        facts.told_status = past.status
        facts.outcome = past.outcome
        size = len(past.goal) + facts.outcome.size
        facts.held = CountedBytes(self._budget, size)
        return facts

    def _failure(self, error: StoreError) -> ServerFailed:
        logger.error("the history of action server %r cannot be read: %s", self._action, error)
        return ServerFailed(HISTORY_FAILED)

"""`AgentGoals`: the goals that a bridge for agents follows.

A task reads each goal to its end, whether or not a tool waits for it, so that no executor waits for
a model. Tools read what the task has noted.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextlib import suppress
from time import time
from typing import Any

import anyio
from anyio import CancelScope
from anyio.abc import TaskGroup

from fibaction.border.abc import Notifier
from fibaction.border.peer_text import clean_logger
from fibaction.client.goal import ClientGoal
from fibaction.words.errors import ActionError, ConnectionLost, GoalRejected
from fibaction.words.goals import CancelAnswer, GoalID, GoalInfo, Outcome
from fibaction.words.statuses import GoalStatus
from fibaction_transports.mcp.tools.tool_actions import ToolAction
from fibaction_transports.mcp.tools.tool_error import ToolError
from fibaction_transports.mcp.tools.tool_names import STATUS

MOST_ACTIVE = 100
"""Goals that a bridge follows at once; more are not sent."""
MOST_ENDED = 100
"""Ended goals whose results are kept for the model to read."""
PROGRESS_PERIOD = 0.2
"""Seconds between two reports of progress, at least."""
SEARCH_TIMEOUT = 5.0
"""Seconds in which the servers list their goals."""
FIRST_UPDATE = 0.5
"""Seconds in which the newest feedback of a goal that others have sent arrives, if there is any."""
CANCEL_TIMEOUT = 5.0
"""Seconds that a cancel may take when the tool that waited for the goal was canceled."""

logger = clean_logger("fibaction.mcp")

Report = Callable[[int, Any], Awaitable[None]]
"""Gets a number that increases with each feedback, and the feedback."""


class AgentGoal:
    """One goal, as far as it is known."""

    def __init__(
        self,
        action: ToolAction,
        goal: ClientGoal[Any, Any],
        *,
        own: bool,
        on_change: Callable[[AgentGoal], None],
    ) -> None:
        """Call `on_change` after each change."""
        self.action = action
        self.own = own
        """True if this bridge has sent it."""
        self.number = 0
        """The number of the newest feedback; 0 before the first."""
        self.feedback: Any = None
        """The newest feedback."""
        self.updates = 0
        """Count of feedback that was read. Unlike the number, it never decreases."""
        self.outcome: Outcome[Any] | None = None
        self.error: ActionError | None = None
        """The reason why the goal cannot be followed any more; it may continue."""
        self.ended = anyio.Event()
        """Set when there is an outcome, or an error."""
        self.news = Notifier()
        self.updated_at = time()
        """The time of the newest change that was read here, in seconds since 1970."""
        self._goal = goal
        self._on_change = on_change

    @property
    def goal_id(self) -> GoalID:
        """The goal's ID."""
        return self._goal.goal_id

    @property
    def stamp(self) -> int:
        """The time of the acceptance, in nanoseconds since 1970."""
        return self._goal.stamp

    @property
    def status(self) -> GoalStatus:
        """The newest status that is known."""
        return self._goal.status if self.outcome is None else self.outcome.status

    async def follow(self) -> None:
        """Read the goal to its end."""
        try:
            async for feedback in self._goal.feedback:
                self.feedback, self.number = feedback, self._goal.feedback.number
                self.updates += 1
                self._note_change()
            self.outcome = await self._goal.outcome()
        except ActionError as exc:
            self.error = exc
        self.ended.set()
        self._note_change()

    def _note_change(self) -> None:
        self.updated_at = time()
        self.news.notify()
        self._on_change(self)

    async def wait(self, seconds: float, report: Report) -> None:
        """Wait for the end for so long, and report the feedback meanwhile, the newest one only."""
        reported = 0
        with anyio.move_on_after(seconds):
            while not self.ended.is_set():
                if self.updates == reported:
                    await self.news.wait()
                    continue
                reported = self.updates
                await report(reported, self.feedback)
                with anyio.move_on_after(PROGRESS_PERIOD):
                    await self.ended.wait()
            if self.updates != reported:
                await report(self.updates, self.feedback)

    async def first_update(self) -> None:
        """Wait a moment for what is known about a goal that others have sent."""
        with anyio.move_on_after(FIRST_UPDATE):
            await self.news.wait()

    async def cancel(self) -> CancelAnswer:
        """Ask the server to cancel the goal.

        Raises:
            ActionError: The server cannot be asked.
        """
        return await self._goal.cancel()

    async def leave(self) -> None:
        """Cancel a goal that its client no longer waits for, in a scope that is canceled."""
        with CancelScope(shield=True), anyio.move_on_after(CANCEL_TIMEOUT):
            try:
                await self.cancel()
            except ActionError as exc:
                logger.warning("goal %s was not canceled, and continues: %s", self.goal_id, exc)


class AgentGoals:
    """The goals that one bridge follows, by their IDs."""

    def __init__(self, tasks: TaskGroup) -> None:
        self._tasks = tasks
        self._goals: dict[GoalID, AgentGoal] = {}
        self.news = Notifier()
        """Notified when a goal has changed."""
        self._changed: dict[GoalID, None] = {}
        self._is_other_list = False

    @property
    def has_changes(self) -> bool:
        """True if a goal has changed since they were taken."""
        return bool(self._changed)

    def take_changes(self) -> tuple[list[GoalID], bool]:
        """Return the goals that have changed, and whether others run now than before."""
        changed, is_other_list = list(self._changed), self._is_other_list
        self._changed, self._is_other_list = {}, False
        return changed, is_other_list

    def _note_change(self, goal: AgentGoal, *, is_new: bool = False) -> None:
        self._changed[goal.goal_id] = None
        self._is_other_list |= is_new or goal.ended.is_set()
        self.news.notify()

    async def send(self, action: ToolAction, message: Any) -> AgentGoal:
        """Send a goal.

        Raises:
            ToolError: It was not accepted, or may not have been.
        """
        if sum(not goal.ended.is_set() for goal in self._goals.values()) >= MOST_ACTIVE:
            raise ToolError(
                f"The goal was not sent: {MOST_ACTIVE} goals of this bridge are active already."
                " Wait for one of them to end, or cancel it."
            )
        try:
            goal = await action.client.send_goal(message)
        except GoalRejected as exc:
            reason = exc.reason or "the server gave no reason"
            advice = ". You may try again later." if exc.code.is_temporary else ""
            raise ToolError(
                f"The goal was rejected, and nothing was done: {reason}{advice}"
            ) from exc
        except ConnectionLost as exc:
            raise ToolError(
                f"The connection was lost, and the goal may have been accepted: {exc}. Call"
                f" {STATUS} without a goal_id before you send it again."
            ) from exc
        except ActionError as exc:
            raise ToolError(f"The goal was not sent: {exc}") from exc
        return self._add(AgentGoal(action, goal, own=True, on_change=self._note_change))

    async def find(self, goal_id: GoalID, actions: list[ToolAction]) -> AgentGoal:
        """Return a goal that is followed already, or follow a goal of these actions from now on.

        Raises:
            ToolError: No server knows it.
        """
        known = self._goals.get(goal_id)
        if known is not None and known.error is None:
            return known
        for action, infos in (await goals_of(actions)).items():
            for info in infos:
                if info.goal_id == goal_id:
                    own = known is not None and known.own
                    return await self._attach(action, info, own=own)
        if known is not None:
            return known
        raise ToolError(
            f"There is no goal {goal_id}: it was never accepted, its server has forgotten it or"
            f" cannot be reached, or its action is not allowed here. Call {STATUS} without a"
            f" goal_id for a list."
        )

    async def _attach(self, action: ToolAction, info: GoalInfo, *, own: bool) -> AgentGoal:
        after = max(info.feedback_count - 1, 0)
        try:
            goal = await action.client.attach(info.goal_id, after=after, attempt=info.attempt)
        except ActionError as exc:
            raise ToolError(f"The goal cannot be followed: {exc}") from exc
        found = self._add(AgentGoal(action, goal, own=own, on_change=self._note_change))
        await found.first_update()
        return found

    def _add(self, goal: AgentGoal) -> AgentGoal:
        self._goals.pop(goal.goal_id, None)
        ended = [one for one in self._goals.values() if one.ended.is_set()]
        for one in ended[: max(len(ended) - MOST_ENDED + 1, 0)]:
            del self._goals[one.goal_id]
        self._goals[goal.goal_id] = goal
        self._note_change(goal, is_new=True)
        self._tasks.start_soon(goal.follow)
        return goal


async def goals_of(actions: list[ToolAction]) -> dict[ToolAction, list[GoalInfo]]:
    """Return the goals that the servers of these actions know, of those that answer soon."""
    found: dict[ToolAction, list[GoalInfo]] = {}

    async def ask(action: ToolAction) -> None:
        with suppress(ActionError):
            found[action] = await action.client.goals()

    with anyio.move_on_after(SEARCH_TIMEOUT):
        async with anyio.create_task_group() as tasks:
            for action in actions:
                tasks.start_soon(ask, action)
    return found

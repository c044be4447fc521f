"""`TaskTable`: the goals that a server of A2A follows, and those that it finds at their servers."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress

import anyio
from a2a.utils.errors import InternalError, TaskNotFoundError
from anyio.abc import TaskGroup

from fibaction.border.abc import GoalRequest, GoalStream
from fibaction.words.errors import ActionError
from fibaction.words.goals import GoalID, GoalInfo
from fibaction_transports.a2a.tasks.followed_task import FollowedTask
from fibaction_transports.a2a.tasks.skills import Skill, Skills

MOST_ACTIVE = 100
"""Goals that are followed at once; more are not sent."""
MOST_ENDED = 100
"""Ended goals that are kept for agents that come back."""
SEARCH_TIMEOUT = 5.0
"""Seconds in which the servers list their goals."""
CATCH_UP = 2.0
"""Seconds in which the updates of a goal arrive that its server has already."""


class TaskTable:
    """The goals of one server, by their IDs."""

    def __init__(self, tasks: TaskGroup, skills: Skills) -> None:
        self._tasks = tasks
        self._skills = skills
        self._goals: dict[GoalID, FollowedTask] = {}

    async def send(
        self, skill: Skill, goal_id: GoalID, payload: bytes, context_id: str
    ) -> FollowedTask:
        """Send a goal. One that is sent again is followed on.

        Raises:
            GoalRejected: It was not accepted.
            InternalError: It was not sent, or may not have been.
        """
        if sum(not goal.ended.is_set() for goal in self._goals.values()) >= MOST_ACTIVE:
            raise InternalError(
                f"the goal was not sent: {MOST_ACTIVE} goals are active here already; wait for one"
                " of them to end, or cancel it"
            )
        offered = skill.endpoint.offer_goal(GoalRequest(goal_id, payload, True))
        stream = offered if isinstance(offered, GoalStream) else await offered
        return self._add(FollowedTask(skill, stream, context_id, own=True))

    async def find(self, goal_id: GoalID) -> FollowedTask:
        """Return a goal that is followed already, or follow a goal of the actions from now on.

        Raises:
            TaskNotFoundError: No server knows it.
            InternalError: It cannot be followed now, or not all servers can be asked.
        """
        known = self._goals.get(goal_id)
        if known is not None and known.error is None:
            return known
        for skill, infos in (await self.listed()).items():
            for info in infos:
                if info.goal_id == goal_id:
                    return await self._attach(skill, info, known)
        if not self._skills.are_all_reached:
            raise InternalError("a server of the actions cannot be reached now: ask again")
        raise TaskNotFoundError(
            f"there is no task {goal_id}: it was never accepted, its server has forgotten it, or"
            f" its action is not allowed here"
        )

    async def listed(self) -> dict[Skill, list[GoalInfo]]:
        """Return the goals that the servers know, of those that answer soon."""
        found: dict[Skill, list[GoalInfo]] = {}

        async def ask(skill: Skill) -> None:
            with suppress(ActionError), await skill.endpoint.status() as statuses:
                found[skill] = await statuses.listed()

        with anyio.move_on_after(SEARCH_TIMEOUT):
            async with anyio.create_task_group() as tasks:
                for skill in self._skills.by_label.values():
                    tasks.start_soon(ask, skill)
        return found

    def context_of(self, goal_id: GoalID) -> str:
        """Return the context of a task, which is its own ID unless an agent has given one here."""
        known = self._goals.get(goal_id)
        return str(goal_id) if known is None else known.context_id

    async def _attach(
        self, skill: Skill, info: GoalInfo, known: FollowedTask | None
    ) -> FollowedTask:
        own = known is not None and known.own
        try:
            stream = await skill.endpoint.feedback(
                info.goal_id, after=0, own=own, attempt=info.attempt
            )
        except ActionError as exc:
            raise InternalError(f"the task cannot be followed now: {exc}") from exc
        context_id = "" if known is None else known.context_id
        goal = self._add(FollowedTask(skill, stream, context_id, own=own))
        with anyio.move_on_after(CATCH_UP):
            if info.status.is_terminal:
                await goal.ended.wait()
            await goal.has_read(info.feedback_count)
        return goal

    def _add(self, goal: FollowedTask) -> FollowedTask:
        self._goals.pop(goal.goal_id, None)
        for one in _oldest_ended(self._goals.values()):
            del self._goals[one.goal_id]
        self._goals[goal.goal_id] = goal
        self._tasks.start_soon(goal.follow)
        return goal


def _oldest_ended(goals: Iterable[FollowedTask]) -> list[FollowedTask]:
    """Return the ended goals that make room for one more."""
    ended = [one for one in goals if one.ended.is_set()]
    return ended[: max(len(ended) - MOST_ENDED + 1, 0)]

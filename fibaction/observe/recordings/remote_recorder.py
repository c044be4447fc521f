"""`record_from`: a recording of a server from outside, as one of its clients.

Each goal is followed as an observer, for which no executor waits. What an observer is not told is
missing in the recording: rejected goals, answers to cancels, the goal itself of one that has ended
at once or that ROS 2 carries, and feedback that came faster than it was read, which is counted. A
`Recorder` inside the server misses nothing of that.
"""

from __future__ import annotations

from contextlib import suppress

import anyio
import msgspec
from anyio.abc import TaskGroup

from fibaction._api import ClientConnection
from fibaction.border.abc import Endpoint, FeedbackItem
from fibaction.border.event_loop import Background
from fibaction.observe.action_listener import actions_after_pause
from fibaction.observe.recordings.recorder import Recorder
from fibaction.types.action import ActionInfo
from fibaction.words.errors import ActionError, UnknownGoal
from fibaction.words.goals import GoalID, GoalInfo, Outcome

__all__ = ["record_from"]

RETRY_PAUSE = 1.0
"""Seconds before an action whose server has stopped is followed again."""
MOST_FOLLOWED = 1000
"""Goals that are followed at the same time; others wait for their turn."""
REMEMBERED = 10_000
"""Goals that are known to be followed: as many as a server keeps."""


async def record_from(connection: ClientConnection, recorder: Recorder) -> None:
    """Record the active and the new goals of all actions of a server, until canceled.

    Restarts of the server and new actions are waited for. For example:

        with Recorder("today.jsonl") as recorder:
            async with connect("tcp://127.0.0.1:7400") as connection:
                await record_from(connection, recorder)

    Raises:
        ActionError: The server is not found.
        OSError: The file cannot be written to any longer.
    """
    actions: list[ActionInfo] | None = await connection.actions()
    known: set[str] = set()
    async with Background() as tasks:
        observer = _Observer(connection, recorder, tasks)
        while recorder.error is None:
            for info in actions or ():
                if info.name not in known:
                    known.add(info.name)
                    tasks.start_soon(observer.record_action, info)
            actions, _ = await actions_after_pause(connection)
        raise recorder.error


class _Observer:
    """The tasks that follow actions and goals, and record what they are told."""

    def __init__(self, connection: ClientConnection, recorder: Recorder, tasks: TaskGroup) -> None:
        self._connection = connection
        self._recorder = recorder
        self._tasks = tasks
        self._room = anyio.CapacityLimiter(MOST_FOLLOWED)
        self._seen: dict[GoalID, None] = {}

    async def record_action(self, info: ActionInfo) -> None:
        """Record the goals of an action, even after restarts of its server, until canceled."""
        try:
            endpoint = self._connection.endpoint(info)
        except ActionError:  # its ROS type is not installed here
            return
        while True:
            with suppress(ActionError):
                await self._record_goals(endpoint)
            await anyio.sleep(RETRY_PAUSE)  # limits how often a permanent error is met
            await endpoint.wait_for_server()

    async def _record_goals(self, endpoint: Endpoint) -> None:
        with await endpoint.status() as statuses:
            self._recorder.opened(endpoint.info)
            known = statuses.known
            while (goal := await statuses.receive()) is not None:
                known -= 1
                has_ended = not goal.status.is_active
                if goal.goal_id not in self._seen and not (has_ended and known >= 0):
                    self._remember(goal.goal_id)
                    self._tasks.start_soon(self._record_goal, endpoint, goal)

    def _remember(self, goal_id: GoalID) -> None:
        self._seen[goal_id] = None
        if len(self._seen) > REMEMBERED:
            del self._seen[next(iter(self._seen))]

    async def _record_goal(self, endpoint: Endpoint, goal: GoalInfo) -> None:
        action, recorder = endpoint.info.name, self._recorder
        async with self._room:
            try:
                with await endpoint.feedback(goal.goal_id, after=0) as stream:
                    recorder.accepted(action, goal, stream.goal or b"")
                    async for update in stream:
                        if isinstance(update, FeedbackItem):
                            recorder.feedback(action, goal.goal_id, update)
                        elif isinstance(update, Outcome):
                            ended = msgspec.structs.replace(goal, status=update.status)
                            recorder.ended(action, ended, update)
                        else:
                            goal = msgspec.structs.replace(goal, status=update)
                            recorder.changed(action, goal)
                    recorder.add_dropped(stream.dropped)
            except UnknownGoal:
                pass  # it has ended and was forgotten in the meantime
            except ActionError as exc:
                recorder.left(action, goal, str(exc))

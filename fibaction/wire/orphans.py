"""Whose goal is whose, and what becomes of a goal whose client has lost its connection."""

from __future__ import annotations

import logging
from hmac import compare_digest
from typing import Literal

from anyio import sleep
from anyio.abc import TaskGroup

from fibaction.abc import Endpoint, GoalStream
from fibaction.exceptions import GoalRejected
from fibaction.goals import GoalID
from fibaction.protocol import ID_IN_USE

logger = logging.getLogger("fibaction.wire")


class Orphans:
    """The streams of goals' own clients, of all connections of one server: one for each goal.

    When a connection is lost its streams stay open, so the executor waits for the client as it
    waits for one that does not read, and the feedback of the meantime is there when it comes back.
    """

    def __init__(
        self, tasks: TaskGroup, *, grace: float, then: Literal["keep", "cancel"] = "keep"
    ) -> None:
        """Wait `grace` seconds for a client, and then keep its goals running or cancel them."""
        self._tasks = tasks
        self._grace = grace
        self._then = then
        self._streams: dict[GoalID, GoalStream] = {}
        self._sessions: dict[GoalID, bytes] = {}
        self._goals: dict[GoalID, int] = {}  # enough to tell that another goal is sent
        self._losses: dict[GoalStream, object] = {}

    def is_own(self, goal_id: GoalID, session: bytes) -> bool:
        """Whether it was a client of this session that sent the goal."""
        known = self._sessions.get(goal_id, b"")
        return bool(known) and compare_digest(known, session)

    def own(self, stream: GoalStream, session: bytes, goal: bytes | None = None) -> bool:
        """A client follows its goal with this stream: the one before, if any, is of no use more,
        be it an orphan or on a connection that is dead and has not been found out. `goal` is what
        it has sent, if it does so now.

        False, and nothing else, if the goal is that of a client of another session.
        """
        before = self._streams.get(stream.goal_id)
        if before is not None and not self.is_own(stream.goal_id, session):
            return False
        self._streams[stream.goal_id] = stream
        self._sessions[stream.goal_id] = session
        if goal is not None:
            self._goals[stream.goal_id] = hash(goal)
        self._losses.pop(before or stream, None)
        if before is not None and before is not stream:
            before.close()
        return True

    def ended(
        self, goal_id: GoalID, session: bytes, goal: bytes | None = None
    ) -> GoalStream | None:
        """The stream of a goal of that session that has ended, and whose client has not heard of
        it. `goal` is what it sends again.

        Raises:
            GoalRejected: That is another goal.
        """
        stream = self._streams.get(goal_id)
        if stream is None or not stream.status.is_terminal or not self.is_own(goal_id, session):
            return None
        if goal is not None and self._goals.get(goal_id) != hash(goal):
            raise GoalRejected(ID_IN_USE, goal_id=goal_id)
        return stream

    def close(self) -> None:
        """The server closes: no goal waits for its client any longer."""
        for stream in tuple(self._streams.values()):
            self.end(stream)

    def end(self, stream: GoalStream) -> None:
        """The client has been told how the goal ended, or follows it elsewhere."""
        stream.close()
        self._losses.pop(stream, None)
        if self._streams.get(stream.goal_id) is stream:
            del self._streams[stream.goal_id], self._sessions[stream.goal_id]
            self._goals.pop(stream.goal_id, None)

    def adopt(self, endpoint: Endpoint, stream: GoalStream, *, left: bool) -> None:
        """The stream's connection is lost; `left` says that the client said goodbye."""
        owned = self._streams.get(stream.goal_id) is stream
        if not owned or (left and self._then == "keep"):
            self.end(stream)
        else:
            loss = self._losses[stream] = object()
            self._tasks.start_soon(self._wait, endpoint, stream, loss, 0 if left else self._grace)

    async def _wait(
        self, endpoint: Endpoint, stream: GoalStream, loss: object, grace: float
    ) -> None:
        await sleep(grace)
        if self._losses.get(stream) is not loss:
            return  # the client came back, and may have been lost again
        self.end(stream)
        if self._then == "cancel" and not stream.status.is_terminal:
            logger.info("goal %s is canceled: its client has not come back", stream.goal_id)
            try:
                await endpoint.cancel_goals(stream.goal_id)
            except Exception as exc:  # whatever an endpoint of somebody else's does
                logger.warning("goal %s could not be canceled: %s", stream.goal_id, exc)

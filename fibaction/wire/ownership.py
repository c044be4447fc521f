"""Whose goal is whose, and what becomes of a goal whose client has lost its connection."""

from __future__ import annotations

import logging
from hmac import compare_digest
from typing import Literal, NamedTuple

from anyio import CancelScope, sleep
from anyio.abc import TaskGroup

from fibaction.abc import Endpoint, GoalStream
from fibaction.exceptions import GoalRejected
from fibaction.goals import GoalID
from fibaction.server.goal_record import digest_of
from fibaction.server.registry import ID_IN_USE

logger = logging.getLogger("fibaction.wire")


class _Owned(NamedTuple):
    """A goal that one client follows as its own."""

    stream: GoalStream
    session: bytes
    digest: bytes | None
    """Digest of the goal; None if it was sent before this server knew it."""

    def is_of(self, session: bytes) -> bool:
        """Whether it is the goal of a client of that session."""
        return bool(self.session) and compare_digest(self.session, session)


class Owners:
    """The streams of goals' own clients, of all connections of one server: one for each goal, that
    of the last call if there are more.

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
        self._owned: dict[GoalID, _Owned] = {}
        self._losses: dict[GoalID, CancelScope] = {}  # of those whose client is waited for

    def is_own(self, goal_id: GoalID, session: bytes) -> bool:
        """Whether it was a client of this session that sent the goal."""
        owned = self._owned.get(goal_id)
        return owned is not None and owned.is_of(session)

    def own(self, stream: GoalStream, session: bytes, goal: bytes | None = None) -> bool:
        """A client follows its goal with this stream, and if its connection is lost, this is the
        one to keep. What was kept for it so far is of no use more. `goal` is what it has sent, if
        it does so now.

        False, and nothing else, if the goal is that of a client of another session.
        """
        before = self._owned.get(stream.goal_id)
        digest = None if goal is None else digest_of(goal)
        if before is not None:
            if not before.is_of(session):
                return False
            digest = before.digest if digest is None else digest
            # One that nobody waits for is that of another call on the same connection: it goes on.
            if self._wait_no_more(stream.goal_id) and before.stream is not stream:
                before.stream.close()
        self._owned[stream.goal_id] = _Owned(stream, session, digest)
        return True

    def ended(
        self, goal_id: GoalID, session: bytes, goal: bytes | None = None
    ) -> GoalStream | None:
        """The stream of a goal of that session that has ended, and whose client has not heard of
        it. `goal` is what it sends again.

        Raises:
            GoalRejected: That is another goal.
        """
        owned = self._owned.get(goal_id)
        if owned is None or not owned.stream.status.is_terminal or not owned.is_of(session):
            return None
        if goal is not None and owned.digest != digest_of(goal):
            raise GoalRejected(ID_IN_USE, goal_id=goal_id)
        return owned.stream

    def close(self) -> None:
        """The server closes: no goal waits for its client any longer."""
        for owned in tuple(self._owned.values()):
            self.end(owned.stream)

    def end(self, stream: GoalStream) -> None:
        """The client has been told how the goal ended, or follows it elsewhere."""
        stream.close()
        owned = self._owned.get(stream.goal_id)
        if owned is not None and owned.stream is stream:
            del self._owned[stream.goal_id]
            self._wait_no_more(stream.goal_id)

    def adopt(self, endpoint: Endpoint, stream: GoalStream, *, left: bool) -> None:
        """The stream's connection is lost; `left` says that the client said goodbye."""
        owned = self._owned.get(stream.goal_id)
        if owned is None or owned.stream is not stream or (left and self._then == "keep"):
            self.end(stream)
        else:
            loss = self._losses[stream.goal_id] = CancelScope()
            self._tasks.start_soon(self._wait, endpoint, stream, loss, 0 if left else self._grace)

    def _wait_no_more(self, goal_id: GoalID) -> bool:
        """Whether its client was waited for."""
        loss = self._losses.pop(goal_id, None)
        if loss is not None:
            loss.cancel()  # or it would wait on, and keep the stream: for ever, if so long is given
        return loss is not None

    async def _wait(
        self, endpoint: Endpoint, stream: GoalStream, loss: CancelScope, grace: float
    ) -> None:
        with loss:
            await sleep(grace)
        if self._losses.get(stream.goal_id) is not loss:
            return  # the client came back, and may have been lost again
        self.end(stream)
        if self._then == "cancel" and not stream.status.is_terminal:
            logger.info("goal %s is canceled: its client has not come back", stream.goal_id)
            try:
                await endpoint.cancel_goals(stream.goal_id)
            except Exception as exc:  # whatever an endpoint of somebody else's does
                logger.warning("goal %s could not be canceled: %s", stream.goal_id, exc)

"""`Owners`: which goal belongs to which client, and what happens to it when the client is gone.

Theory of operation
-------------------

A goal belongs to the client that has sent it: to its *session*, the secret that the client sends on
each of its connections. `Owners` has one entry for each goal with an owner, for all connections of
one server: the stream by which the owner follows the goal (that of the last call, if there are
more), the session, and a digest of the goal. The entry begins when the owner's stream does (`own`),
and lasts until the owner has the end of the goal, or is not waited for any longer (`end`).

When a connection is lost, its session releases the streams of its client (`adopt`). They stay open,
so the executor waits for the client as it waits for one that does not read, and the feedback of the
meantime is there when it comes back. A task waits `grace` seconds for that. Then:

- The client comes back and follows its goal again: `own` replaces the stream, and the wait ends.
- The client comes back after the goal has ended: `ended` gives the old stream, which still has the
  feedback and the outcome, also if the server has forgotten the goal. A goal that is *sent* again
  is compared by its digest, so that another goal of the same ID is rejected.
- The client does not come back: the stream is closed, and the goal runs on without it (`"keep"`),
  or is canceled (`"cancel"`). A client that has said goodbye is not waited for.

A stream that is replaced while its connection is open is that of another call of the same client.
It goes on by itself, and only loses its entry. An observer of a goal has no entry here.
"""

from __future__ import annotations

from hmac import compare_digest
from typing import Literal, NamedTuple

from anyio import CancelScope, sleep
from anyio.abc import TaskGroup

from fibaction._log import clean_logger
from fibaction.abc import Endpoint, GoalStream
from fibaction.exceptions import GoalRejected
from fibaction.goals import GoalID
from fibaction.server.goal_record import digest_of
from fibaction.server.registry import ID_IN_USE

logger = clean_logger("fibaction.wire")


class _Owned(NamedTuple):
    """A goal, with the stream and the session of its owner."""

    stream: GoalStream
    session: bytes
    digest: bytes | None
    """Digest of the goal; None if it was sent before this server knew it."""

    def is_of(self, session: bytes) -> bool:
        """Return whether the goal belongs to that session."""
        return bool(self.session) and compare_digest(self.session, session)


class Owners:
    """The owners of the goals of one server, and the streams by which they follow them."""

    def __init__(
        self, tasks: TaskGroup, *, grace: float, then: Literal["keep", "cancel"] = "keep"
    ) -> None:
        """Wait `grace` seconds for a client, and then keep its goals running or cancel them."""
        self._tasks = tasks
        self._grace = grace
        self._then = then
        self._owned: dict[GoalID, _Owned] = {}
        self._losses: dict[GoalID, CancelScope] = {}  # of goals whose owner is waited for

    def is_own(self, goal_id: GoalID, session: bytes) -> bool:
        """Return whether a client of this session has sent the goal."""
        owned = self._owned.get(goal_id)
        return owned is not None and owned.is_of(session)

    def own(self, stream: GoalStream, session: bytes, goal: bytes | None = None) -> bool:
        """Record `stream` as the owner's stream, replacing any earlier one.

        `goal` is the goal, if it is sent now. Return False, and change nothing, if the goal belongs
        to another session.
        """
        before = self._owned.get(stream.goal_id)
        digest = None if goal is None else digest_of(goal)
        if before is not None:
            if not before.is_of(session):
                return False
            digest = before.digest if digest is None else digest
            # If the client was not waited for, the earlier stream is another call's: it goes on.
            if self._stop_waiting(stream.goal_id) and before.stream is not stream:
                before.stream.close()
        self._owned[stream.goal_id] = _Owned(stream, session, digest)
        return True

    def ended(
        self, goal_id: GoalID, session: bytes, goal: bytes | None = None
    ) -> GoalStream | None:
        """Return the stream of a goal of that session that has ended, and may not have been told.

        `goal` is the goal, if it is sent again.

        Raises:
            GoalRejected: It is another goal of the same ID.
        """
        owned = self._owned.get(goal_id)
        if owned is None or not owned.stream.status.is_terminal or not owned.is_of(session):
            return None
        if goal is not None and owned.digest != digest_of(goal):
            raise GoalRejected(ID_IN_USE, goal_id=goal_id)
        return owned.stream

    def close(self) -> None:
        """End all entries: the server closes."""
        for owned in tuple(self._owned.values()):
            self.end(owned.stream)

    def end(self, stream: GoalStream) -> None:
        """Close a stream of an owner that has the end of the goal, or does not wait for it."""
        stream.close()
        owned = self._owned.get(stream.goal_id)
        if owned is not None and owned.stream is stream:
            del self._owned[stream.goal_id]
            self._stop_waiting(stream.goal_id)

    def adopt(self, endpoint: Endpoint, stream: GoalStream, *, left: bool) -> None:
        """Keep a stream whose connection is lost, or end it.

        `left` says that the client said goodbye.
        """
        owned = self._owned.get(stream.goal_id)
        if owned is None or owned.stream is not stream or (left and self._then == "keep"):
            self.end(stream)
        else:
            loss = self._losses[stream.goal_id] = CancelScope()
            self._tasks.start_soon(self._wait, endpoint, stream, loss, 0 if left else self._grace)

    def _stop_waiting(self, goal_id: GoalID) -> bool:
        """Stop waiting for the owner of a goal; return whether it was waited for."""
        loss = self._losses.pop(goal_id, None)
        if loss is not None:
            loss.cancel()  # the task would keep the stream, for ever if `grace` is infinite
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
            except Exception as exc:  # an endpoint may be foreign code
                logger.warning("goal %s could not be canceled: %s", stream.goal_id, exc)

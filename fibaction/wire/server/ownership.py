"""`Owners`: which goal belongs to which client, and what happens to it when the client is gone.

Theory of operation
-------------------

A goal belongs to the client that has sent it: to its *owner*, a digest that is the same on each
connection of the client. `Owners` has one entry for each goal with an owner, for all connections of
one server: the owner, a digest of the goal, and the calls by which the owner follows the goal.
Mostly this is one call; there are more if the client sends the goal again, or follows it again. The
entry begins with the first call (`own`), and lasts until the owner has the end of the goal in each
of them, or is not waited for any longer (`end`). An observer of a goal has no entry here.

All calls of one connection are in its `HeldGoals`. When the connection is lost (`lose`), these
stay open, so the executor waits for the client as it waits for one that does not read, and the
feedback of the meantime is there when it comes back. One task for each lost connection waits
`grace` seconds for that. Then:

- The client comes back and follows its goal again: `own` replaces one of the lost calls. The others
  hold the executor no longer, and wait for the client only to tell it the end.
- The client comes back after the goal has ended: `ended` gives the stream of a lost call, which
  still has the feedback and the outcome, even if the server has forgotten the goal. If the client
  asks more often than there are lost calls, it gets the outcome alone. A goal that is *sent* again
  is compared by its digest, so that another goal of the same ID is rejected.
- The client does not come back in time: the streams are closed, and the goal runs on without them
  (`"keep"`), or is canceled (`"cancel"`). A client that has said goodbye is not waited for.

The goals that are kept for all lost clients together have a limit, or one client could lose its
connection over and over, each time with as many goals as it may have. The goals that were lost
first are then given up before their time.

A connection may have ten thousand goals. To lose it takes one step, `is_lost`, whatever their
number; what is to be done for each of them is done in slices, between which others have their turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from hmac import compare_digest
from typing import Literal

from anyio import CancelScope, current_time, sleep_until
from anyio.abc import TaskGroup

from fibaction._runtime.log import clean_logger
from fibaction._runtime.notify import Notifier
from fibaction.border.abc import Endpoint, GoalStream, GoalUpdate
from fibaction.border.event_loop import Slices
from fibaction.wire.messages import Follow
from fibaction.wire.server.subscriptions import GoalSubscription, HeldGoals
from fibaction.words.errors import ActionError, GoalRejected, RejectionCode, UnknownGoal
from fibaction.words.goals import ID_IN_USE, GoalID, GoalInfo, Outcome, digest_of
from fibaction.words.statuses import GoalStatus

logger = clean_logger("fibaction.wire")


class EndOnly(GoalStream):
    """One more stream of a goal that has ended, which has the outcome and no feedback."""

    __slots__ = ("_stream", "cursor", "goal_id", "latest", "news", "reads", "stamp")

    def __init__(self, stream: GoalStream) -> None:
        self.goal_id, self.stamp, self.latest = stream.goal_id, stream.stamp, stream.latest
        self.cursor = stream.cursor
        self.reads = False
        self.news = Notifier()
        self._stream = stream

    @property
    def status(self) -> GoalStatus:
        return self._stream.status

    @property
    def attempt(self) -> int:
        return self._stream.attempt

    @property
    def info(self) -> GoalInfo:
        return self._stream.info

    @property
    def dropped(self) -> int:
        return self._stream.cursor - self.cursor

    def take(self, limit: int = 1) -> Sequence[GoalUpdate]:
        outcome = self.known_outcome()
        self.cursor = self._stream.cursor
        return () if outcome is None else (outcome,)

    def known_outcome(self) -> Outcome[bytes] | None:
        return self._stream.known_outcome()

    def seek(self, cursor: int) -> None:
        self.cursor = min(cursor, self._stream.cursor)

    def hold(self, wanted: bool) -> None:
        """Do nothing: there is no executor any more."""

    def close(self) -> None:
        """Do nothing: only the outcome is delivered anyway."""

    def fail(self, error: ActionError) -> None:
        """Do nothing: the outcome is known."""


class _Owned:
    """A goal with an owner."""

    __slots__ = ("calls", "digest", "owner")

    def __init__(self, owner: bytes, digest: bytes | None, call: GoalSubscription) -> None:
        self.owner = owner
        self.digest = digest
        """Digest of the goal; None if it was sent before this server knew it."""
        self.calls: tuple[GoalSubscription, ...] = (call,)

    def is_of(self, owner: bytes) -> bool:
        """Return whether the goal belongs to that owner."""
        return bool(self.owner) and compare_digest(self.owner, owner)

    @property
    def lost(self) -> list[GoalSubscription]:
        """The calls whose connections are lost."""
        return [call for call in self.calls if call.held.is_lost]


class Owners:
    """The owners of the goals of one server, and the calls by which they follow them."""

    def __init__(
        self,
        tasks: TaskGroup,
        *,
        grace: float,
        then: Literal["keep", "cancel"] = "keep",
        limit: int,
    ) -> None:
        """Wait `grace` seconds for a client, and then keep its goals running or cancel them.

        At most `limit` goals are kept for lost clients: the oldest are given up sooner.
        """
        self._tasks = tasks
        self._grace = grace
        self._then = then
        self._limit = limit
        self._owned: dict[GoalID, _Owned] = {}
        self._lost: dict[HeldGoals, int] = {}  # with their goals, in the order of their loss
        self._lost_goals = 0
        self._has_closed = False

    def is_own(self, goal_id: GoalID, owner: bytes) -> bool:
        """Return whether that client has sent the goal."""
        owned = self._owned.get(goal_id)
        return owned is not None and owned.is_of(owner)

    def own(
        self, call: GoalSubscription, stream: GoalStream, owner: bytes, goal: bytes | None = None
    ) -> bool:
        """Record that the owner follows its goal by `stream` in a call, perhaps in place of a call
        that is lost.

        `goal` is the goal, if it is sent now. Return False, and change nothing, if the goal belongs
        to another client.
        """
        goal_id = stream.goal_id
        owned = self._owned.get(goal_id)
        digest = None if goal is None else digest_of(goal)
        if owned is None:
            self._owned[goal_id] = _Owned(owner, digest, call)
            return True
        if not owned.is_of(owner):
            return False
        owned.digest = digest or owned.digest
        if lost := owned.lost:
            replaced = next((one for one in lost if one.stream is stream), lost[-1])
            self._replace(owned, replaced, stream)
        owned.calls += (call,)
        return True

    def _replace(self, owned: _Owned, replaced: GoalSubscription, stream: GoalStream) -> None:
        """Forget a lost call: its client continues by another stream, or by the same."""
        owned.calls = tuple(call for call in owned.calls if call is not replaced)
        replaced.held.forget(replaced)
        replaced.leave()
        if replaced.stream is not stream:
            _stream_of(replaced).close()
        for call in owned.lost:  # the client is here, so only what it reads may hold the executor
            _stream_of(call).hold(False)

    def ended(self, goal_id: GoalID, owner: bytes, goal: bytes | None = None) -> GoalStream | None:
        """Return a stream of a goal of that client that has ended, and may not have been told.

        `goal` is the goal, if it is sent again.

        Raises:
            GoalRejected: It is another goal of the same ID.
        """
        owned = self._owned.get(goal_id)
        if owned is None or not owned.is_of(owner):
            return None
        ended = [call for call in owned.calls if _stream_of(call).status.is_terminal]
        if not ended:
            return None
        if goal is not None and owned.digest is None and _endpoint_of(ended[-1]).owner_of(goal_id):
            return None  # the endpoint has kept the goal since before a restart, and compares it
        if goal is not None and owned.digest not in (None, digest_of(goal)):
            raise GoalRejected(ID_IN_USE, goal_id=goal_id, code=RejectionCode.DUPLICATE)
        lost = [_stream_of(call) for call in ended if call.held.is_lost]
        if not lost:
            return EndOnly(_stream_of(ended[-1]))
        return next((stream for stream in lost if stream.reads), lost[-1])

    async def follow(self, message: Follow, endpoint: Endpoint, owner: bytes) -> GoalStream:
        """Return the stream of a goal that a client wants to follow; its owner is empty if it
        follows the goal of another client.

        If the client has not been told the end of its own goal yet, it is that goal: its server may
        have forgotten it, and may even have another client's goal of the same ID by now.

        Raises:
            UnknownGoal: There is no such goal.
        """
        goal_id = GoalID(message.goal_id)
        try:
            stream = await endpoint.feedback(
                goal_id, after=message.after, own=bool(owner), attempt=message.attempt
            )
        except UnknownGoal:
            ended = self.ended(goal_id, owner)
            if ended is None:
                raise
        else:
            ended = self.ended(goal_id, owner)
            if ended is None or ended.stamp == stream.stamp:
                return stream
            stream.close()
        if message.after is not None:
            ended.seek(message.after if message.attempt == ended.attempt else 0)
        return ended

    def end(self, call: GoalSubscription) -> None:
        """Close the stream of a call whose client has the end of the goal, or does not wait for it,
        or only observes it.
        """
        stream = call.stream
        assert stream is not None
        stream.close()
        owned = self._owned.get(stream.goal_id)
        if owned is not None and call in owned.calls:
            if len(owned.calls) > 1:
                owned.calls = tuple(one for one in owned.calls if one is not call)
            else:
                del self._owned[stream.goal_id]

    def lose(self, held: HeldGoals, *, left: bool) -> None:
        """Keep the goals of a connection that has ended, or end them.

        `left` says that the client said goodbye.
        """
        held.is_lost = True
        if self._has_closed:
            for call in tuple(held.calls.values()):
                if held.has(call):
                    self._end_lost(call)
        elif held.calls:
            self._lost[held] = len(held.calls)
            self._lost_goals += len(held.calls)
            while self._lost_goals > self._limit:
                oldest = next(iter(self._lost))
                self._forget(oldest)
                oldest.wait.cancel()
            self._tasks.start_soon(self._wait, held, left)

    def _forget(self, held: HeldGoals) -> None:
        self._lost_goals -= self._lost.pop(held, 0)

    async def aclose(self) -> None:
        """End all entries: the server closes."""
        self._has_closed = True
        slices = Slices()
        try:
            with CancelScope(shield=True):
                while self._owned:
                    self._end_first()
                    await slices.pause()
        finally:  # asyncio can cancel the task itself, which no scope shields
            while self._owned:
                self._end_first()

    def _end_first(self) -> None:
        _, owned = self._owned.popitem()
        for call in owned.calls:
            _stream_of(call).close()

    async def _wait(self, held: HeldGoals, left: bool) -> None:
        """Wait for the client of a lost connection, and give its goals up if it does not come."""
        try:
            await self._release(held, left)
        except Exception as exc:  # of a stream, which may be foreign code
            logger.error("the goals of a lost client could not be released", exc_info=exc)

    async def _release(self, held: HeldGoals, left: bool) -> None:
        grace_over = current_time() + (0 if left else self._grace)
        slices = Slices()
        for call in tuple(held.calls.values()):
            if held.has(call):
                self._keep(call, left)
            await slices.pause()
        with held.wait:
            await sleep_until(grace_over)
        self._forget(held)
        canceled = 0
        for call in tuple(held.calls.values()):
            if held.has(call):
                if self._cancels(call):
                    self._tasks.start_soon(self._cancel, call)
                    canceled += 1
                else:
                    self._end_lost(call)
            await slices.pause()
        if canceled:
            logger.info("canceling the goals of a client that has not come back: %d", canceled)

    def _keep(self, call: GoalSubscription, left: bool) -> None:
        """Keep a lost call for its client, if it may come back for it."""
        owned = self._owned.get(GoalID(call.goal_id))
        if owned is None or not call.own or (left and self._then == "keep"):
            self._end_lost(call)  # there is no entry any more if the server closes
            return
        call.leave()
        if owned.calls[-1] is not call:
            _stream_of(call).hold(False)  # the executor waits for the last call alone

    def _cancels(self, call: GoalSubscription) -> bool:
        """Return whether the goal of a lost call is to be canceled: no other call follows it."""
        return (
            self._then == "cancel"
            and not self._has_closed
            and call.own
            and self._owned[GoalID(call.goal_id)].calls == (call,)
            and not _stream_of(call).status.is_terminal
        )

    def _end_lost(self, call: GoalSubscription) -> None:
        call.held.forget(call)
        call.leave()
        self.end(call)

    async def _cancel(self, call: GoalSubscription) -> None:
        """Cancel the goal of a lost call, which holds its executor until then."""
        goal_id = GoalID(call.goal_id)
        try:
            await _endpoint_of(call).cancel_goals(goal_id)
        except Exception as exc:  # an endpoint may be foreign code
            logger.warning("goal %s could not be canceled: %s", goal_id, exc)
        if call.held.has(call):  # else the client has come back meanwhile
            self._end_lost(call)


def _endpoint_of(call: GoalSubscription) -> Endpoint:
    assert call.endpoint is not None
    return call.endpoint


def _stream_of(call: GoalSubscription) -> GoalStream:
    assert call.stream is not None
    return call.stream

"""What a client has under way: a question with one answer, a goal, or the statuses of all goals.

A `Call` knows what to send when a connection is opened, for the first time or anew, and takes what
comes back. It knows nothing of connections; what it wants to say meanwhile goes through `post`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from fibaction._notify import Notifier
from fibaction.abc import FeedbackItem, GoalStream, GoalUpdate, StatusStream
from fibaction.exceptions import ActionError, ProtocolError
from fibaction.goals import UNKNOWN_OUTCOME, GoalID, GoalInfo, Outcome
from fibaction.states import GoalStatus
from fibaction.wire.errors import copied, error_of
from fibaction.wire.messages import (
    Close,
    Credit,
    Ended,
    Failed,
    Feedback,
    Finished,
    Follow,
    Following,
    FromClient,
    GoalChanged,
    Received,
    Rejected,
    SendGoal,
    StatusChanged,
    Watching,
    WatchStatus,
    Why,
)

Post: TypeAlias = Callable[[FromClient], None]
"""Sends a small message if there is a connection; if there is none, it is not needed."""


class Call(ABC):
    """Something that is under way."""

    def __init__(self, call_id: int) -> None:
        self.id = call_id
        """The same on every connection."""
        self.news = Notifier()
        self.error: ActionError | None = None
        self._is_answered = False

    @property
    def is_over(self) -> bool:
        """Whether nobody wants anything of it any more, so that it need not be opened again."""
        return False

    @abstractmethod
    def opening(self) -> FromClient:
        """What to send on a new connection, so that it goes on."""

    def giving_up(self) -> FromClient:
        """What to send when nobody waits for the answer any more."""
        return Close(self.id)

    @abstractmethod
    def on_message(self, message: Any) -> bool:
        """Take a message of its ID, and say whether that was the last one.

        Raises:
            ProtocolError: It does not fit.
        """

    async def answered(self) -> None:
        """Wait until the server has granted it.

        Raises:
            ActionError: It has not, or the connection is lost.
        """
        while not self._is_answered:
            self.raise_error()
            await self.news.wait()

    def fail(self, error: ActionError) -> None:
        """Nothing more will come, for that reason."""
        self.error = error
        self.news.notify()

    def raise_error(self) -> None:
        """Raise what it failed with, if it has; each time a new one, as it may be raised often."""
        if self.error is not None:
            raise copied(self.error)


class PendingRequest(Call):
    """A request with one answer."""

    def __init__(self, call_id: int, message: FromClient) -> None:
        super().__init__(call_id)
        self._message = message
        self._answer: Any = None

    def opening(self) -> FromClient:
        return self._message

    def on_message(self, message: Any) -> bool:
        if isinstance(message, Failed):
            goal_id = getattr(self._message, "goal_id", None)
            self.fail(error_of(message, GoalID(goal_id) if goal_id else None))
        else:
            self._answer = message
            self._is_answered = True
            self.news.notify()
        return True

    def answer(self, kind: type[Any]) -> Any:
        """The answer, when there is one.

        Raises:
            ProtocolError: It is not of that kind.
        """
        if not isinstance(self._answer, kind):
            raise _unfitting(self._answer)
        return self._answer


class _Credits:
    """How many more messages of one call the other end may send."""

    def __init__(self, call_id: int, window: int, post: Post) -> None:
        self._id = call_id
        self._window = window
        # In larger pieces: one message for each would cost more than what it is for.
        self._piece = (window + 1) // 2
        self._post = post
        self._allowed = window
        self._ungranted = 0

    def restart(self, unread: int) -> int:
        """On a new connection: how many may come, as so many of the window are still unread."""
        self._ungranted = 0
        self._allowed = self._window - unread
        return self._allowed

    def spend(self) -> None:
        """A message has come.

        Raises:
            ProtocolError: It was one too many.
        """
        if self._allowed <= 0:
            raise ProtocolError("there were more messages than credit for them")
        self._allowed -= 1

    def grant(self, count: int = 1) -> None:
        """So many were read, and as many more may come."""
        self._ungranted += count
        if self._ungranted >= self._piece:
            self._allowed += self._ungranted
            self._post(Credit(self._id, self._ungranted))
            self._ungranted = 0


class RemoteGoal(Call, GoalStream):
    """One goal at the other end."""

    def __init__(
        self, goal_id: GoalID, opening: SendGoal | Follow, window: int, post: Post
    ) -> None:
        super().__init__(opening.id)
        self.goal_id = goal_id
        self.stamp = 0
        self.latest = False
        self.cursor = 0
        self._opening = opening
        self._window = window
        self._post = post
        self._status = GoalStatus.UNKNOWN
        self._outcome: Outcome[bytes] | None = None
        self._last = 0  # the number of the feedback that arrived last
        self._start = 0
        self._delivered = 0
        self._items: deque[FeedbackItem] = deque()
        self._statuses: deque[GoalStatus] = deque()
        self._credit = _Credits(opening.id, window, post)
        self._own = isinstance(opening, SendGoal) or opening.own
        self._holds = self._own  # an observer slows nobody down, here neither
        self.reads = opening.credit is not None

    @property
    def status(self) -> GoalStatus:
        return self._status

    @property
    def dropped(self) -> int:
        return self.cursor - self._start - self._delivered

    @property
    def is_own(self) -> bool:
        """Whether this client has sent the goal."""
        return self._own

    def giving_up(self) -> FromClient:
        return Close(self.id) if self._own else Received(self.id)

    def __del__(self) -> None:
        # Nobody can ask for the end any more, and the server need not keep it in mind until then.
        if self._is_answered and not self._own and self._outcome is None and self.error is None:
            self._post(self.giving_up())

    def take(self, limit: int = 1) -> Sequence[GoalUpdate]:
        if self._statuses:
            return (self._statuses.popleft(),)
        waiting = self._items
        if not waiting:
            if self._outcome is None:
                self.raise_error()
                return ()
            if self.reads:
                self.cursor = self._last
            return (self._outcome,)
        if limit == 1:  # what a reader asks for, message by message
            items = [waiting.popleft()]
        else:
            items = [waiting.popleft() for _ in range(min(limit, len(waiting)))]
        if items:
            self.cursor = items[-1].number
            self._delivered += len(items)
            if self._outcome is None and not self.latest:
                self._credit.grant(len(items))
        return items

    def known_outcome(self) -> Outcome[bytes] | None:
        if self._outcome is None:
            self.raise_error()
        return self._outcome

    def hold(self, wanted: bool) -> None:
        self._holds = wanted and self._own
        self._make_room()

    def close(self) -> None:
        if self.reads:
            self.reads = False
            self._items.clear()
            self._statuses.clear()
            self.news.notify()
            if self._outcome is None:
                self._post(Close(self.id))

    def opening(self) -> FromClient:
        allowed = self._credit.restart(0 if self.latest else len(self._items))
        if not self._is_answered:
            return self._opening
        credit = allowed if self.reads else None
        return Follow(self.id, self._opening.action, self.goal_id, self._last, self._own, credit)

    def on_message(self, message: Any) -> bool:
        # Where most messages pass: for a class of msgspec's, `isinstance` takes ten times as long.
        kind = message.__class__
        if kind is Feedback and self._is_answered:
            self._take_feedback(message)
        elif kind is Following:
            self._take_following(message)
        elif kind is StatusChanged and self._is_answered:
            self._take_status(message.status)
        elif kind is Ended and self._is_answered:
            if message.status.is_active:
                raise ProtocolError(f"a goal has ended as {message.status.name}")
            self._end(Outcome(message.status, message.result, message.reason), message.place)
            self._post(Received(self.id))
        elif kind is Failed and self._is_answered and message.why == Why.UNKNOWN_GOAL:
            # The server was started anew, or it took so long that the result has expired.
            self._end(UNKNOWN_OUTCOME, self._last)
        elif kind is Failed or kind is Rejected:
            self.fail(error_of(message, self.goal_id))
        else:
            raise _unfitting(message)
        self.news.notify()
        return self._outcome is not None or self.error is not None

    def _take_following(self, message: Following) -> None:
        if self._is_answered and message.stamp != self.stamp:
            # The server was started anew, and has been sent another goal of that ID.
            self._end(UNKNOWN_OUTCOME, self._last)
            self._post(Close(self.id))
        elif self._is_answered:
            self._take_status(message.status)  # it may have changed while there was no connection
        else:
            self._is_answered = True
            self._status = message.status
            self.stamp, self.latest = message.stamp, message.latest
            self.cursor = self._start = self._last = message.place

    def _take_status(self, status: GoalStatus) -> None:
        # Statuses only ever grow. On a new connection the server says first what it is by now, and
        # may then tell what the last connection has not.
        if status > self._status:
            self._status = status
            if self.reads and status.is_active:
                self._statuses.append(status)

    def _take_feedback(self, message: Feedback) -> None:
        if message.number <= self._last:
            raise ProtocolError(f"feedback {message.number} came after {self._last}")
        self._credit.spend()
        self._last = message.number
        if self.reads:
            if self.latest:
                self._items.clear()
                self._credit.grant()
            self._items.append(FeedbackItem(message.number, message.payload))
            if not self._holds:
                self._make_room()

    def _end(self, outcome: Outcome[bytes], place: int) -> None:
        self._outcome = outcome
        self._status = outcome.status
        self._last = max(place, self._last)

    def _make_room(self) -> None:
        """If the executor is not to wait, let go of the oldest for the server to send the next."""
        if self._holds or self.latest or self._outcome is not None:
            return
        while len(self._items) > max(self._window // 2, 1):
            self._items.popleft()
            self._credit.grant()


class RemoteStatuses(Call, StatusStream):
    """The statuses of all goals at the other end."""

    def __init__(self, call_id: int, action: str, window: int, post: Post) -> None:
        super().__init__(call_id)
        self._action = action
        self._window = window
        self._post = post
        self.known = 0
        self._taken = 0
        self._items: deque[GoalInfo] = deque()
        self._ended = False
        self._dropped = 0
        self._dropped_before = 0  # on connections before this one
        self._credit = _Credits(call_id, window, post)

    @property
    def is_over(self) -> bool:
        return self._ended

    @property
    def dropped(self) -> int:
        return self._dropped_before + self._dropped

    async def receive(self) -> GoalInfo | None:
        while not self._items:
            if self._ended:
                return None
            self.raise_error()
            await self.news.wait()
        return self._take()

    async def listed(self) -> list[GoalInfo]:
        goals: dict[GoalID, GoalInfo] = {}
        while self._taken < self.known:  # it may be less after a connection was lost
            if self._items:
                info = self._take()
                goals[info.goal_id] = info
            elif self._ended:
                break
            else:
                self.raise_error()
                await self.news.wait()
        return list(goals.values())

    def _take(self) -> GoalInfo:
        self._taken += 1
        if not self._ended:
            self._credit.grant()
        return self._items.popleft()

    def close(self) -> None:
        if not self._ended:
            self._ended = True
            self._post(Close(self.id))
            self.news.notify()

    def opening(self) -> FromClient:
        self._dropped_before, self._dropped = self.dropped, 0
        return WatchStatus(self.id, self._action, self._credit.restart(len(self._items)))

    def on_message(self, message: Any) -> bool:
        if not self._is_answered and not isinstance(message, Watching | Failed):
            raise _unfitting(message)
        if isinstance(message, GoalChanged):
            self._credit.spend()
            self._dropped = message.dropped
            if not self._ended:
                info = GoalInfo(
                    GoalID(message.goal_id),
                    message.stamp,
                    message.status,
                    message.feedback_count,
                    message.client,
                )
                self._items.append(info)
        elif isinstance(message, Watching):
            # On a new connection all goals come anew, behind what has come on those before.
            self.known = self._taken + len(self._items) + message.known
            self._is_answered = True
        elif isinstance(message, Finished):
            self._ended = True
        elif isinstance(message, Failed):
            self.fail(error_of(message))
        else:
            raise _unfitting(message)
        self.news.notify()
        return isinstance(message, Finished | Failed)


def _unfitting(message: object) -> ProtocolError:
    return ProtocolError(f"a {type(message).__name__} does not answer what was asked")

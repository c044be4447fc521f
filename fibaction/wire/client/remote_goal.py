"""`RemoteGoal`: a goal that a client follows over a connection, and goes on with on the next.

It keeps a window of feedback that was not read, grants credit for what was, and knows the number of
the last feedback, from which it goes on after a connection was lost.

A server that keeps its goals may have begun another attempt at the goal by then, whose feedback is
numbered from 1 again. `Following` tells it. Feedback of the earlier attempt that was not read yet
moves to `_earlier`, and is read first; `attempt` and `cursor` are those of the reader. The attempt
may also be a lower one, since a store that need not outlive a power failure can lose its last
writes: each attempt that is not the one before begins anew.

A client that has connections to several servers, which share their goals, gives `on_lost`. A goal
whose connection or server cannot go on with it is given to that function then, and does not end.
It waits there, without messages, until another connection adopts it (`OpenCalls.adopt`), or until
it is finished or failed from outside. No caller notices.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

from fibaction._runtime.text import shortened
from fibaction.border.abc import FeedbackItem, GoalStream, GoalUpdate
from fibaction.wire.client.calls import Call, Credits, Post, unfitting
from fibaction.wire.codec import FromClient
from fibaction.wire.deadlines import timeout_until
from fibaction.wire.errors import error_of
from fibaction.wire.messages import (
    Close,
    Ended,
    Failed,
    Feedback,
    FeedbackBatch,
    Follow,
    Following,
    Received,
    Rejected,
    SendGoal,
    StatusChanged,
)
from fibaction.words.errors import (
    ActionError,
    ConnectionLost,
    ProtocolError,
    ServerNotFound,
    UnknownGoal,
)
from fibaction.words.goals import UNKNOWN_OUTCOME, GoalID, Outcome
from fibaction.words.statuses import GoalStatus


class _Earlier(NamedTuple):
    """The unread feedback of an attempt that another one has followed."""

    items: deque[FeedbackItem]
    last: int
    """The number of the feedback that arrived last."""
    next_attempt: int


OnLost: TypeAlias = "Callable[[RemoteGoal, ActionError], None]"


class RemoteGoal(Call, GoalStream):
    """One goal of a server, followed over a connection."""

    def __init__(
        self,
        goal_id: GoalID,
        opening: SendGoal | Follow,
        window: int,
        post: Post,
        deadline: float = math.inf,
        on_lost: OnLost | None = None,
    ) -> None:
        super().__init__(opening.id)
        self.goal_id = goal_id
        self.stamp = 0
        self.latest = False
        self.cursor = 0
        self.on_lost = on_lost
        """Takes the goal once it is answered; None lets it end with the error."""
        self.on_ended: Callable[[], None] | None = None
        """Called when the server has told the end, unless the goal was lost before."""
        self.lost_at: float | None = None
        """Time at which it was lost, noted by `on_lost`; None when a server goes on with it."""
        self._is_released = False
        self._opening = opening
        self._window = window
        self._post = post
        self._deadline = deadline
        self._status = GoalStatus.UNKNOWN
        self._goal = opening.goal if isinstance(opening, SendGoal) else None
        self._outcome: Outcome[bytes] | None = None
        self._attempt = 1
        self._newest = 1  # the attempt of the feedback that arrives
        self._last = 0  # the number of the feedback that arrived last
        self._start = 0
        self._delivered = 0  # of the attempt that is read
        self._dropped = 0  # in the attempts before
        self._items: deque[FeedbackItem] = deque()
        self._earlier: deque[_Earlier] = deque()
        self._statuses: deque[GoalStatus] = deque()
        self._credit = Credits(opening.id, window, post)
        self._own = isinstance(opening, SendGoal) or opening.own
        self._holds = self._own  # an observer never slows the executor down
        self.reads = opening.credit is not None

    @property
    def status(self) -> GoalStatus:
        return self._status

    @property
    def attempt(self) -> int:
        return self._attempt

    @property
    def newest_attempt(self) -> int:
        return self._newest

    @property
    def dropped(self) -> int:
        return self._dropped + self.cursor - self._start - self._delivered

    @property
    def goal(self) -> bytes | None:
        return self._goal

    @property
    def is_own(self) -> bool:
        """True if this client has sent the goal."""
        return self._own

    @property
    def action(self) -> str:
        """The name of the action."""
        return self._opening.action

    def giving_up(self) -> FromClient:
        return Close(self.id) if self._own else Received(self.id)

    def __del__(self) -> None:
        # The end cannot be asked for any more, so the server need not tell it.
        if self._is_answered and not self._own and self._outcome is None and self.error is None:
            self._post(self.giving_up())

    def take(self, limit: int = 1) -> Sequence[GoalUpdate]:
        if self._statuses:
            return (self._statuses.popleft(),)
        waiting = self._unread_of_earlier() if self._earlier else self._items
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
            self._forget_unread()
            self._statuses.clear()
            self.news.notify()
            if self._outcome is None:
                self._post(Close(self.id))

    def opening(self) -> FromClient:
        allowed = self._credit.restart(0 if self.latest else self._unread)
        if not self._is_answered:
            if self._deadline < math.inf and isinstance(self._opening, SendGoal):
                self._opening.timeout = timeout_until(self._deadline)
            return self._opening
        credit = allowed if self.reads else None
        action, last, attempt = self._opening.action, self._last, self._newest
        return Follow(self.id, action, self.goal_id, last, self._own, credit, attempt)

    def on_message(self, message: Any) -> bool:
        # Where most messages pass: for a class of msgspec's, `isinstance` takes ten times as long.
        kind = message.__class__
        if kind is Feedback and self._is_answered:
            self._take_feedback(message.number, (message.payload,))
        elif kind is FeedbackBatch and self._is_answered:
            self._take_feedback(message.number, message.payloads)
        elif kind is Following:
            self._take_following(message)
        elif kind is StatusChanged and self._is_answered:
            self._take_status(message.status)
        elif kind is Ended and self._is_answered:
            if message.status.is_active:
                raise ProtocolError(f"a goal has ended as {message.status.name}")
            outcome = Outcome(message.status, message.result, shortened(message.reason))
            self._end(outcome, message.place)
            self._post(Received(self.id))
            if self.on_ended is not None:
                self.on_ended()
        elif kind is Failed or kind is Rejected:
            self.lose(error_of(message, self.goal_id))
        else:
            raise unfitting(message)
        self.news.notify()
        return self._outcome is not None or self.error is not None or self._is_released

    def lose(self, error: ActionError) -> None:
        is_lost = isinstance(error, ConnectionLost | ServerNotFound | UnknownGoal)
        if is_lost and self._is_answered and self.on_lost is not None:
            self._is_released = True
            self.on_ended = None
            self.on_lost(self, error)
        elif self._is_answered and isinstance(error, UnknownGoal):
            # The server was started anew, or the result has expired meanwhile.
            self._end(UNKNOWN_OUTCOME, self._last)
            self.news.notify()
        else:
            self.fail(error)

    def move_to(self, post: Post) -> None:
        """Go on with another connection, which sends small messages by `post`."""
        self._is_released = False
        self._post = self._credit.post = post

    def finish(self, outcome: Outcome[bytes], number: int, attempt: int) -> None:
        """End the goal by what is known without its server; `number` is that of the last feedback
        of the attempt. Feedback that has not arrived is lost.
        """
        if attempt != self._newest:
            self._take_attempt(attempt)
        self._end(outcome, number)
        self.news.notify()

    def _take_following(self, message: Following) -> None:
        self.lost_at = None
        if self._is_answered and message.stamp != self.stamp:
            # The server was started anew, and has been sent another goal of that ID.
            self._end(UNKNOWN_OUTCOME, self._last)
            self._post(Close(self.id))
        elif self._is_answered:
            self._take_status(message.status)  # it may have changed while there was no connection
            if message.attempt != self._newest:
                self._take_attempt(message.attempt)
        else:
            self._is_answered = True
            self._status = message.status
            self.stamp, self.latest = message.stamp, message.latest
            self._attempt = self._newest = message.attempt
            self.cursor = self._start = self._last = message.place
            if message.goal is not None:
                self._goal = message.goal

    # Attempts

    def _take_attempt(self, attempt: int) -> None:
        """Begin to count anew: the feedback that arrives from now on is of another attempt."""
        if self._earlier and not self._items:
            # The attempt between the two had no feedback. A server could tell ever more of them.
            self._earlier[-1] = self._earlier[-1]._replace(next_attempt=attempt)
        else:
            self._earlier.append(_Earlier(self._items, self._last, attempt))
            self._items = deque()
        self._newest, self._last = attempt, 0
        self._unread_of_earlier()

    def _unread_of_earlier(self) -> deque[FeedbackItem]:
        """Return the unread feedback that comes next; go on to its attempt if it is another one."""
        while self._earlier and not self._earlier[0].items:
            earlier = self._earlier.popleft()
            if self.reads:
                self.cursor = earlier.last
            self._dropped = self.dropped
            self._attempt = earlier.next_attempt
            self.cursor = self._start = self._delivered = 0
        return self._earlier[0].items if self._earlier else self._items

    @property
    def _unread(self) -> int:
        unread = len(self._items)
        for earlier in self._earlier:
            unread += len(earlier.items)
        return unread

    def _forget_unread(self) -> None:
        self._items.clear()
        for earlier in self._earlier:
            earlier.items.clear()
        self._unread_of_earlier()

    # Messages of the server

    def _take_status(self, status: GoalStatus) -> None:
        # Statuses only ever grow. On a new connection the server says first what it is by now, and
        # may then tell what the last connection has not.
        if status > self._status:
            self._status = status
            if self.reads and status.is_active:
                self._statuses.append(status)

    def _take_feedback(self, first: int, payloads: Sequence[bytes]) -> None:
        """Take feedback with consecutive numbers."""
        if first <= self._last:
            raise ProtocolError(f"feedback {first} came after {self._last}")
        count = len(payloads)
        self._credit.spend(count)
        self._last = first + count - 1
        if not self.reads:
            return
        if self.latest:
            self._forget_unread()
            self._credit.grant(count)
            first, payloads = self._last, payloads[-1:]
        attempt = self._newest
        self._items += [
            FeedbackItem(number, payload, attempt) for number, payload in enumerate(payloads, first)
        ]
        if not self._holds:
            self._make_room()

    def _end(self, outcome: Outcome[bytes], place: int) -> None:
        self._outcome = outcome
        self._status = outcome.status
        self._last = max(place, self._last)

    def _make_room(self) -> None:
        """Drop the oldest feedback for the next, unless the executor is to wait."""
        if self._holds or self.latest or self._outcome is not None:
            return
        while self._unread > max(self._window // 2, 1):
            self._unread_of_earlier().popleft()
            self._credit.grant()

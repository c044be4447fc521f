"""`RemoteGoal`: a goal that a client follows over a connection, and continues with on the next.

Theory of operation
-------------------

A `RemoteGoal` is the call by which a client follows one goal, and the stream that the goal's reader
has. It holds what has arrived and was not read (`UnreadFeedback`, and the statuses), the credit for
more, and what it takes to continue elsewhere: the number of the last feedback, and its attempt.

Its phases, each of which ends with the next or with an error:

- *Opening*, until `Following` comes (`is_answered`). On each connection, `OpenCalls` sends the same
  message again: the goal, or the request to follow it.
- *Following*. The server sends feedback as far as there is credit, and statuses. When a connection
  is lost nothing ends: `opening` is a `Follow` then, from the last feedback that has arrived.
- *Released*, only with `on_lost`, which a client has that has connections to several servers with
  shared goals. A goal whose connection or server cannot continue with it is given to that function.
  It waits there, without messages, until another connection adopts it (`OpenCalls.adopt`), or until
  it is finished or failed from outside. No caller notices.
- *Ended*, with the outcome, which `Ended` tells, and which is answered by `Received`; or with an
  error (`fail`). If the server does not know the goal any more, the outcome is unknown.

`OpenCalls` calls `opening`, `on_message` and `lose`; the reader calls `take`, `known_outcome`,
`hold` and `close`, and waits for `news`. Small messages, such as credit, go to `post`.

Invariants: a status is never followed by a lower one, and the number of feedback grows within an
attempt; else the server is at fault. Unread feedback never exceeds the credit that was given. An
outcome stays once it is known, and comes after all feedback. A goal that is not read gives no more
credit, and so its executor waits, unless the stream does not hold: then the oldest feedback makes
room for the next.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from time import time_ns
from typing import Any, TypeAlias

from anyio import current_time
from msgspec.structs import astuple, replace

from fibaction._runtime.text import shortened
from fibaction.border.abc import FeedbackItem, GoalUpdate
from fibaction.wire.client.calls import Call, Credits, Post, unfitting
from fibaction.wire.client.unread_feedback import NOTHING, UnreadFeedback
from fibaction.wire.errors import error_of
from fibaction.wire.messages import (
    LONGEST_TIMEOUT,
    Close,
    Ended,
    Failed,
    Feedback,
    FeedbackBatch,
    Follow,
    Following,
    FromClient,
    Received,
    Rejected,
    SendGoal,
    StatusChanged,
    labels_from,
    parent_from,
)
from fibaction.words.errors import (
    ActionError,
    ConnectionLost,
    ProtocolError,
    ServerNotFound,
    UnknownGoal,
)
from fibaction.words.goals import UNKNOWN_OUTCOME, GoalID, GoalInfo, Outcome, Parent
from fibaction.words.statuses import GoalStatus

LEAST_TIMEOUT = 0.001
"""Seconds that are sent for a deadline that has passed, since 0 is not a timeout."""

OnLost: TypeAlias = "Callable[[RemoteGoal, ActionError], None]"


class RemoteGoal(Call, UnreadFeedback):
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
        Call.__init__(self, opening.id)
        UnreadFeedback.__init__(self)
        self.goal_id = goal_id
        self.stamp = 0
        self.latest = False
        self._on_lost = on_lost
        self._on_ended: Callable[[], None] | None = None
        self.lost_at: float | None = None
        """Time at which it was lost, noted by `on_lost`; None when a server continues with it."""
        self.told_info: GoalInfo | None = None
        """The goal as an entry of a list, if its end was told with all of it."""
        self._is_released = False
        self._opening = opening
        self._window = window
        self._post = post
        self._deadline = deadline
        self._status = GoalStatus.UNKNOWN
        self._goal = opening.goal if isinstance(opening, SendGoal) else None
        self._parent: Parent | None = None
        self._labels: dict[str, str] = {}
        self._outcome: Outcome[bytes] | None = None
        self._statuses: tuple[GoalStatus, ...] = ()  # that were not read; most goals have one
        self._credit = Credits(opening.id, window, post)
        self._own = isinstance(opening, SendGoal) or opening.own
        self._holds = self._own  # an observer never slows the executor down
        self.reads = opening.credit is not None

    @property
    def status(self) -> GoalStatus:
        return self._status

    @property
    def goal(self) -> bytes | None:
        return self._goal

    @property
    def info(self) -> GoalInfo:
        if self.told_info is not None:
            return self.told_info
        info, parent, labels = super().info, self._parent, self._labels
        return replace(info, feedback_count=self._last, parent=parent, labels=labels)

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
        if self.is_answered and not self._own and self._outcome is None and self.error is None:
            self._post(self.giving_up())

    def take(self, limit: int = 1) -> Sequence[GoalUpdate]:
        if self._statuses:
            first, self._statuses = self._statuses[:1], self._statuses[1:]
            return first
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
            if self._items or self._earlier:
                self._forget_unread()
            self._statuses = ()
            self.news.notify()
            if self._outcome is None:
                self._post(Close(self.id))

    def opening(self) -> FromClient:
        if not self.is_answered:
            if self._deadline < math.inf and isinstance(self._opening, SendGoal):
                self._opening.timeout = _timeout_until(self._deadline)
            return self._opening
        allowed = self._credit.restart(0 if self.latest else self._unread)
        credit = allowed if self.reads else None
        action, last, attempt = self._opening.action, self._last, self._newest
        return Follow(self.id, action, self.goal_id, last, self._own, credit, attempt)

    def on_message(self, message: Any) -> bool:
        # Where most messages pass: for a class of msgspec's, `isinstance` takes ten times as long.
        kind = message.__class__
        if kind is Feedback and self.is_answered:
            at = message.at
            self._take_feedback(message.number, (message.payload,), None if at is None else (at,))
        elif kind is FeedbackBatch and self.is_answered:
            self._take_feedback(message.number, message.payloads, message.times)
        elif kind is Following:
            self._take_following(message)
        elif kind is StatusChanged and self.is_answered:
            self._take_status(message.status)
        elif kind is Ended and self.is_answered:
            if message.status.is_active:
                raise ProtocolError(f"a goal has ended as {message.status.name}")
            _, status, result, reason, place, *more = astuple(message)
            self._end(Outcome(status, result, reason and shortened(reason), *more), place)
            self._post(Received(self.id))
            if self._on_ended is not None:
                self._on_ended()
        elif kind is Failed or kind is Rejected:
            self.lose(error_of(message, self.goal_id))
        else:
            raise unfitting(message)
        self.news.notify()
        return self._outcome is not None or self.error is not None or self._is_released

    def lose(self, error: ActionError) -> None:
        is_lost = isinstance(error, ConnectionLost | ServerNotFound | UnknownGoal)
        if is_lost and self.is_answered and self._on_lost is not None:
            self._is_released = True
            self._on_ended = None
            self._on_lost(self, error)
        elif self.is_answered and isinstance(error, UnknownGoal):
            # The server was restarted, or the result has expired meanwhile.
            self._end(UNKNOWN_OUTCOME, self._last)
            self.news.notify()
        else:
            self.fail(error)

    def when_ended(self, callback: Callable[[], None]) -> None:
        """Call a function when the server has told the end, unless the goal is lost before."""
        self._on_ended = callback

    def move_to(self, post: Post, on_lost: OnLost) -> None:
        """Continue with another connection, which sends small messages by `post`; `on_lost` gets
        the goal if that one cannot continue, either.
        """
        self._is_released, self._on_lost = False, on_lost
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
        if self.is_answered and message.stamp != self.stamp:
            # The server was restarted, and has been sent another goal of that ID.
            self._end(UNKNOWN_OUTCOME, self._last)
            self._post(Close(self.id))
        elif self.is_answered:
            self._take_status(message.status)  # it may have changed while there was no connection
            if message.attempt != self._newest:
                self._take_attempt(message.attempt)
        else:
            self.is_answered = True
            self._status = message.status
            self.stamp, self.latest = message.stamp, message.latest
            self._attempt = self._newest = message.attempt
            self.cursor = self._start = self._last = message.place
            if message.goal is not None:
                self._goal = message.goal
            if message.parent is not None:
                self._parent = parent_from(message.parent)
            if message.labels is not None:
                self._labels = labels_from(message.labels)
            if message.checkpoint is not None:
                self.checkpoint = message.checkpoint

    # Messages of the server

    def _take_status(self, status: GoalStatus) -> None:
        # Statuses only ever grow. On a new connection the server says first what it is by now, and
        # may then tell what the last connection has not.
        if status > self._status:
            self._status = status
            if self.reads and status.is_active:
                self._statuses += (status,)

    def _take_feedback(
        self, first: int, payloads: Sequence[bytes], times: Sequence[int] | None
    ) -> None:
        """Take feedback with consecutive numbers, which has arrived now if no times are told."""
        if first <= self._last:
            raise ProtocolError(f"feedback {first} came after {self._last}")
        count = len(payloads)
        if times is None:
            times = (time_ns(),) * count
        elif len(times) != count:
            raise ProtocolError(f"{count} messages of feedback have {len(times)} times")
        self._credit.spend(count)
        self._last = first + count - 1
        if not self.reads:
            return
        if self.latest:
            self._forget_unread()
            self._credit.grant(count)
            first, payloads, times = self._last, payloads[-1:], times[-1:]
        attempt, numbers = self._newest, range(first, self._last + 1)
        if self._items is NOTHING:
            self._items = deque()
        self._items += [
            FeedbackItem(number, payload, attempt, at)
            for number, payload, at in zip(numbers, payloads, times, strict=True)
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


def _timeout_until(deadline: float) -> float | None:
    """Return the timeout to send for a deadline, since the clocks of two processes differ: the
    seconds that are left, or None if they are too many.
    """
    left = deadline - current_time()
    return max(left, LEAST_TIMEOUT) if left <= LONGEST_TIMEOUT else None

"""`FeedbackCursor`: one follower's position in a goal's log, and so the stream that it reads.

See `feedback_log` for the theory of operation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from fibaction._runtime.notify import Notifier
from fibaction.border.abc import FeedbackItem, GoalStream, GoalUpdate
from fibaction.feeds.patience import Patience
from fibaction.words.errors import ActionError, copy_of
from fibaction.words.statuses import GoalStatus

if TYPE_CHECKING:
    from fibaction.feeds.feedback_log import FeedbackLog
    from fibaction.words.goals import Outcome


class FeedbackCursor(GoalStream):
    """One follower's position in a goal's log."""

    __slots__ = (
        "__weakref__",
        "_dropped",
        "_error",
        "_follows",
        "_log",
        "_may_hold",
        "_stalled",
        "_statuses_told",
        "_wanted",
        "cursor",
        "goal_id",
        "holding",
        "latest",
        "news",
        "own",
        "patience",
        "reads",
        "stamp",
    )

    def __init__(self, log: FeedbackLog, start: int, feedback: bool, own: bool, hold: bool) -> None:
        self.goal_id = log.goal.goal_id
        self.stamp = log.goal.stamp
        self.latest = log.latest
        self.own = own
        self.cursor = start
        self.reads = feedback
        self._stalled = False
        self.news = Notifier()
        self._log = log
        self._follows = feedback
        self._may_hold = hold
        self.holding = hold
        """True if the executor waits for this cursor."""
        self.patience: Patience | None = None
        """The time for which it waits; None if that is the server's stall timeout."""
        self._wanted = True
        self._dropped = 0
        self._statuses_told = len(log.statuses)
        self._error: ActionError | None = None

    @property
    def status(self) -> GoalStatus:
        return self._log.goal.told_status

    @property
    def attempt(self) -> int:
        return self._log.goal.attempt

    @property
    def goal(self) -> bytes | None:
        return self._log.payload

    @property
    def dropped(self) -> int:
        return self._dropped

    def take(self, limit: int = 1) -> Sequence[GoalUpdate]:
        log, outcome = self._log, self._log.outcome
        if self._error is not None:
            raise copy_of(self._error)
        if self.reads:
            while self._statuses_told < len(log.statuses):
                status = log.statuses[self._statuses_told]
                self._statuses_told += 1
                if status.is_active:
                    return (status,)
            items = log.after(self.cursor, limit)
            if items:
                self._took(items)
                return items
            if log.has_after(self.cursor):
                return ()
        if outcome is None:
            return ()
        self._skip_rest()
        return (outcome,)

    def _skip_rest(self) -> None:
        """Count unread feedback as dropped, unless the stream was opened without feedback."""
        if self._follows:
            self._drop(self._log.count - self.cursor)
            self.seek(self._log.count)

    def _drop(self, count: int) -> None:
        if count:
            self._dropped += count
            self._log.note_dropped(count)

    def _took(self, items: list[FeedbackItem]) -> None:
        last = items[-1].number
        before, self.cursor = self.cursor, last
        self._drop(last - before - len(items))
        if self.holding:
            self._log.note_move(before, last)
        elif self._stalled and last == self._log.count:
            self._stalled = False
            self._update()

    def known_outcome(self) -> Outcome[bytes] | None:
        outcome = self._log.outcome
        if self._error is not None:
            raise copy_of(self._error)
        return outcome

    def seek(self, cursor: int) -> None:
        before, self.cursor = self.cursor, min(max(cursor, 0), self._log.count)
        if self.holding:
            self._log.note_move(before, self.cursor)

    def hold(self, wanted: bool) -> None:
        self._wanted = wanted
        self._update()

    def hold_briefly(self) -> None:
        self.patience = Patience()

    def stall(self) -> None:
        """Stop making the executor wait, until all feedback has been read."""
        self._stalled = True
        self.holding = False

    def _update(self) -> None:
        self.holding = self._may_hold and self._wanted and not self._stalled
        self._log.set_holding(self)

    def close(self) -> None:
        self.reads = False
        self._leave()

    def fail(self, error: ActionError) -> None:
        if self._log.outcome is None:
            self._error = error
        self._leave()

    def _leave(self) -> None:
        self._may_hold = self.holding = False
        self.news.notify()
        self._log.leave(self)

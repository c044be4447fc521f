"""`UnreadFeedback`: the feedback of a remote goal that has arrived and was not read, by attempts.

A server that keeps its goals may have begun another attempt at the goal, whose feedback is numbered
from 1 again. Feedback of the earlier attempt that was not read yet moves to `_earlier`, and is read
first; `attempt` and `cursor` are those of the reader. The attempt may also be a lower one, since a
store that need not outlive a power failure can lose its last writes: each attempt that is not the
one before begins again.

Sans-I/O, and without messages: `RemoteGoal` is the subclass that takes them, and whose credit
bounds what may be unread (`ClientSettings.window`).
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from fibaction.border.abc import FeedbackItem, GoalStream

NOTHING: deque[FeedbackItem] = deque(maxlen=0)
"""No feedback: a deque of its own would be a twentieth of the memory of a goal that has none."""


class _Earlier(NamedTuple):
    """The unread feedback of an attempt that another one has followed."""

    items: deque[FeedbackItem]
    last: int
    """The number of the feedback that arrived last."""
    next_attempt: int


class UnreadFeedback(GoalStream):
    """A stream by which one goal is followed: its unread feedback, and its position in it."""

    # Without these, a goal has more than the 30 attributes up to which CPython 3.11 shares the keys
    # of a class's instances, and takes 1.3 kB more.
    __slots__ = (
        "_attempt",
        "_delivered",
        "_dropped",
        "_earlier",
        "_items",
        "_last",
        "_newest",
        "_start",
        "cursor",
    )

    def __init__(self) -> None:
        self.cursor = 0
        self._attempt = 1
        self._newest = 1  # the attempt of the feedback that arrives
        self._last = 0  # the number of the feedback that arrived last
        self._start = 0
        self._delivered = 0  # of the attempt that is read
        self._dropped = 0  # in the attempts before
        self._items: deque[FeedbackItem] = NOTHING
        # A tuple, as most goals have one attempt: an empty queue would be a seventh of a goal.
        self._earlier: tuple[_Earlier, ...] = ()

    @property
    def attempt(self) -> int:
        return self._attempt

    @property
    def newest_attempt(self) -> int:
        return self._newest

    @property
    def dropped(self) -> int:
        return self._dropped + self.cursor - self._start - self._delivered

    def _take_attempt(self, attempt: int) -> None:
        """Begin to count again: the feedback that arrives from now on is of another attempt."""
        if self._earlier and not self._items:
            # The attempt between the two had no feedback. A server could tell ever more of them.
            *before, last = self._earlier
            self._earlier = (*before, last._replace(next_attempt=attempt))
        else:
            self._earlier += (_Earlier(self._items, self._last, attempt),)
            self._items = NOTHING
        self._newest, self._last = attempt, 0
        self._unread_of_earlier()

    def _unread_of_earlier(self) -> deque[FeedbackItem]:
        """Return the unread feedback that comes next; move to its attempt if it is another one."""
        while self._earlier and not self._earlier[0].items:
            earlier, self._earlier = self._earlier[0], self._earlier[1:]
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

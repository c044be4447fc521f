"""`FeedbackWindow`: the last messages of a goal's feedback, and the readers that it waits for.

Theory of operation
-------------------

The window numbers the feedback (1, 2, 3 and so on), and remembers the last messages once for all
readers. A reader has a cursor: the number of the message that it took last. Nothing is copied to
readers; `append` notifies them, and each takes what comes after its cursor when it likes. So a
reader that does not read costs no memory.

Back-pressure: only a reader that *holds* makes the executor wait. The window is full when the
slowest holding reader is a whole window behind. That position is computed when a reader moves
(`make_room`) and not at each feedback, which makes feedback 1.2 times as fast. A reader that has
not been read for the stall timeout, or that has used up its `HoldTime`, is stalled: it does not
hold until it has caught up. The goal's own client holds, others do not, and with
`feedback="latest"` nobody does: who does not hold loses the oldest messages. A window has 64
messages, and the stall timeout is 10 s, if the server sets no others.

Costs: anyone who may observe a goal may follow it thousands of times. So to begin, to take and to
leave each cost the same however many readers there are; only a feedback costs a notification for
each. The window counts the holding readers at the slowest position (`_standing`), and looks at all
holding ones only when the last of them has left it.

The remembered feedback counts in the server's budget of bytes. While the server is over its budget,
and nothing of ended goals is left to give way (`ByteBudget.make_room`), a window pushes out what
its holding readers have read, up to the newest message, and it is full as soon as one of them has
anything to read.
"""

from __future__ import annotations

import math
import sys
from collections import deque
from itertools import islice
from time import monotonic_ns
from typing import Generic, Protocol, TypeAlias, TypeVar

import anyio
from anyio import current_time

from fibaction._runtime.notify import Notifier
from fibaction.border.abc import FeedbackItem
from fibaction.border.byte_budgets import ByteBudget
from fibaction.feeds.followed_goal import FollowedGoal
from fibaction.words.errors import ActionError

BUDGET_STEP = 0.1
"""Seconds after which a window looks again whether the server is within its budget of bytes."""

UNLIMITED = ByteBudget(sys.maxsize)

NOTHING: deque[FeedbackItem] = deque(maxlen=0)

FollowedT = TypeVar("FollowedT", bound=FollowedGoal)
T = TypeVar("T")

Members: TypeAlias = tuple[T, ...] | dict[T, None]
"""A set in order of entry that costs nothing while it is empty, and little with one member.

A server has some of these for each goal, and most have one member or none. So it is a tuple with
none or one, and a dictionary from two on. Adding and removing take the same time however many
members there are. Iterate over `tuple(members)` where the set may change meanwhile; for a tuple
this copies nothing."""


LONGEST_HOLD = 0.5
"""Seconds of waiting at once, in which a burst of feedback gets through to a reader that reads."""
SHORTEST_HOLD = 0.001
"""Seconds that are not worth a wait."""
HELD_SHARE = 0.1
"""Share of the time that may be spent on waiting: so the executor is slowed by a tenth at most."""


class HoldTime:
    """A time without a limit of its own: that of the server counts."""

    __slots__ = ()

    def left(self) -> float:
        """Return the seconds that are left now."""
        return math.inf

    def spend(self, seconds: float) -> bool:
        """Take the seconds of a wait that has ended now; return whether any are left."""
        return True


UNLIMITED_TIME = HoldTime()


class BriefHold(HoldTime):
    """A bucket of seconds: waiting takes from it, and time fills it again."""

    __slots__ = ("_at", "_left")

    def __init__(self) -> None:
        self._left = LONGEST_HOLD
        self._at = current_time()

    def left(self) -> float:
        now = current_time()
        self._left = min(LONGEST_HOLD, self._left + HELD_SHARE * (now - self._at))
        self._at = now
        return self._left

    def spend(self, seconds: float) -> bool:
        self._left -= seconds
        self._at = current_time()
        return self._left > SHORTEST_HOLD


def with_member(members: Members[T], member: T) -> Members[T]:
    """Return the set with one more member; a dictionary is changed in place."""
    if not members:
        return (member,)
    if isinstance(members, tuple):
        members = dict.fromkeys(members)
    members[member] = None
    return members


def without_member(members: Members[T], member: T) -> Members[T]:
    """Return the set without that member; a dictionary is changed in place."""
    if isinstance(members, tuple):
        return () if member in members else members
    members.pop(member, None)
    return members or ()


class WindowReader(Protocol):
    """A reader, as its window knows it."""

    cursor: int
    """The number of the message that it took last."""
    holding: bool
    """True if the executor waits for it."""
    hold_time: HoldTime
    """The time for which the executor waits for it."""
    news: Notifier
    """The notifier of new messages."""

    def stall(self) -> None:
        """Stop making the executor wait, until all feedback has been read."""

    def fail(self, error: ActionError) -> None:
        """End here: from now on, reading raises an error like this one."""


class FeedbackWindow(Generic[FollowedT]):
    """The last `window` messages of a goal's feedback."""

    __slots__ = (
        "__weakref__",
        "_budget",
        "_holders",
        "_items",
        "_readers",
        "_room",
        "_slowest",
        "_standing",
        "_window",
        "goal",
        "is_hidden",
        "latest",
    )

    def __init__(
        self,
        goal: FollowedT,
        window: int = 1,
        latest: bool = False,
        budget: ByteBudget = UNLIMITED,
    ) -> None:
        self.goal = goal
        self.latest = latest
        """True if a slow reader gets the newest feedback only."""
        self.is_hidden = False
        """True if readers may not have the feedback yet: its attempt is still being written."""
        self._window = window
        self._budget = budget
        self._items: deque[FeedbackItem] = NOTHING
        self._readers: Members[WindowReader] = ()
        self._holders: Members[WindowReader] = ()
        self._slowest: float = math.inf  # the slowest position of a holding reader
        self._standing = 0  # the number of holding readers there
        self._room: Notifier | None = None

    @property
    def count(self) -> int:
        """The number of feedback messages so far, which is the number of the last one."""
        return self.goal.feedback_count

    def append(self, payload: bytes) -> bool:
        """Add feedback, and return whether the window is full now: see `is_full`. In a full window
        it pushes out the oldest.
        """
        goal = self.goal
        number = goal.feedback_count = goal.feedback_count + 1
        items: deque[FeedbackItem] = self._items
        budget = self._budget
        if items is NOTHING:  # a deque is a tenth of the memory of a goal without feedback
            self._items = items = deque(maxlen=self._window)
        elif len(items) == self._window:
            budget.used -= len(items[0].payload)
        items.append(FeedbackItem(number, payload, goal.attempt, monotonic_ns() + goal.clock))
        budget.used += len(payload)
        if budget.used > budget.limit:  # then old feedback goes that no holding reader has to read
            if budget.make_room is not None:
                budget.make_room()
            while budget.is_over and len(items) > 1 and items[0].number <= self._slowest:
                budget.give_back(len(items.popleft().payload))
        readers = self._readers
        for reader in readers if type(readers) is tuple else tuple(readers):
            reader.news.notify()
        unread = number - self._slowest  # as in `is_full`, without a call: each message is here
        return unread >= self._window or (budget.used > budget.limit and unread > 0)

    def clear(self) -> None:
        """Forget all feedback."""
        for item in self._items:
            self._budget.used -= len(item.payload)
        self._items = NOTHING

    # What readers take

    def has_after(self, cursor: int) -> bool:
        """Return whether any feedback after that number is remembered."""
        return cursor < self.goal.feedback_count and bool(self._items) and not self.is_hidden

    def after(self, cursor: int, limit: int) -> list[FeedbackItem]:
        """Return the remembered feedback after that number, at most `limit` messages; with the
        policy `latest`, only the last message.
        """
        items = self._items
        # As `has_after`, without a call: each reader of each message is here.
        if limit < 1 or cursor >= self.goal.feedback_count or not items or self.is_hidden:
            return []
        if self.latest:
            return [items[-1]]
        start = max(0, cursor - items[0].number + 1)
        if limit == 1:
            return [items[start]]
        return list(islice(items, start, start + limit))

    def reveal(self) -> None:
        """Let readers have feedback that was hidden until now."""
        self.is_hidden = False
        for reader in tuple(self._readers):
            reader.news.notify()

    def note_dropped(self, count: int) -> None:
        """Note that a reader has missed feedback. Only logs with watchers tell it."""

    # Back-pressure

    @property
    def is_full(self) -> bool:
        """True if more feedback would push out some that the goal's own client has yet to read, or
        if the client has any to read while the server is over its budget.
        """
        unread = self.goal.feedback_count - self._slowest
        if unread >= self._window:
            return True
        budget = self._budget
        return budget.used > budget.limit and unread > 0

    async def wait_for_room(self, seconds: float) -> None:
        """Wait until the window is no longer full, for at most that long, and as long as its
        readers may hold.

        A reader that has not been read by then stops making the executor wait, until it has caught
        up.
        """
        while True:
            slow = self._slow()
            began = anyio.current_time()
            least = min([seconds, *(reader.hold_time.left() for reader in slow)])
            if await self._has_room_within(least):
                for reader in slow:
                    reader.hold_time.spend(anyio.current_time() - began)
                return
            waited = anyio.current_time() - began
            for reader in self._slow():
                may_hold = reader.hold_time.spend(waited)
                if waited >= seconds or not may_hold:
                    reader.stall()
                    self._holders = without_member(self._holders, reader)
            self.make_room()
            if not self.is_full:
                return
            seconds -= waited

    def _slow(self) -> list[WindowReader]:
        """Return the readers for which the executor waits now, if the window is full."""
        least = 1 if self._budget.is_over else self._window
        return [reader for reader in self._holders if self.count - reader.cursor >= least]

    async def _has_room_within(self, seconds: float) -> bool:
        if self._room is None:
            self._room = Notifier()
        with anyio.move_on_after(seconds):
            while self.is_full:
                # The budget does not tell when it has room again.
                limit = math.inf if self.count - self._slowest >= self._window else BUDGET_STEP
                with anyio.move_on_after(limit):
                    await self._room.wait()
            return True
        return False

    def set_holding(self, reader: WindowReader) -> None:
        """Make the executor wait for the reader, or no longer, as the reader now says."""
        is_holding = reader in self._holders
        if reader.holding is is_holding:
            return
        if is_holding:
            self._holders = without_member(self._holders, reader)
            self._count(reader.cursor, math.inf)
        else:
            self._holders = with_member(self._holders, reader)
            self._count(math.inf, reader.cursor)

    def note_move(self, before: int, after: int) -> None:
        """Note that a holding reader has moved."""
        holders = len(self._holders)
        if holders == 1:
            self._slowest = after
            if self._room is not None:
                self._room.notify()
        elif holders:  # else the goal has ended
            self._count(before, after)

    def _count(self, before: float, after: float) -> None:
        """Count a holding reader at its new position; infinity is that of one without effect."""
        if after < self._slowest:
            self._slowest = after
            self._standing = 1
            return
        self._standing += (after == self._slowest) - (before == self._slowest)
        if self._standing < 1:
            self.make_room()

    def make_room(self) -> None:
        """Recompute the slowest position, since the slowest readers have moved."""
        self._slowest, self._standing = math.inf, 0
        for reader in self._holders:
            if reader.cursor < self._slowest:
                self._slowest, self._standing = reader.cursor, 1
            else:
                self._standing += reader.cursor == self._slowest
        if self._room is not None:
            self._room.notify()

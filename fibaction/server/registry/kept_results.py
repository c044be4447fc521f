"""The time for which ended goals are remembered, `ExpiringMap`, and their bytes, `KeptResults`.

Theory of operation
-------------------

The time is an argument. Expiry is exact, whether or not the memory has been freed: `get` compares
the time, and `expire` frees.

The result of an ended goal is held by the registry, which *remembers* it for the result timeout,
and by the goal's log, as long as a stream of the goal is open. A result that is no longer
remembered, and that such a stream still has to deliver, is *unread*. Registry and log reference one
`HeldBytes`, so the bytes count in the budget of the server until neither has them. The feedback
that the log still has after the end is counted with the result, and goes with it.

If the budget is used up, `next_to_forget` has results give way. It is the client that holds most,
so that one client does not push out the results of others: of clients with tokens, the token whose
clients hold most together, and of these the one that holds most. Its remembered results go first,
since no one may want them any longer, and then its unread ones, each time the oldest. Unread
results may have half of the budget even if goals and feedback take it all, and the result of the
goal that has ended last stays: its client could not have read it yet.

A `Share` has the results of one client. It exists as long as one of them: `KeptResults` has weak
references to shares, and a share has weak references to what is unread.
"""

from __future__ import annotations

import math
from collections import Counter, OrderedDict
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Generic, TypeVar
from weakref import ReferenceType, WeakValueDictionary, ref

from fibaction.border.byte_budgets import ByteBudget
from fibaction.words.goals import GoalID, Sender

MOST_LOST = 200
"""Unread results that are lost by one call."""

T = TypeVar("T")

if TYPE_CHECKING:
    from fibaction.feeds.feedback_log import FeedbackLog


class ExpiringMap(Generic[T]):
    """A bounded mapping whose entries expire after a fixed time."""

    def __init__(self, seconds: float, limit: int) -> None:
        """Make an empty map.

        Each entry is kept for `seconds` (0 not at all, `math.inf` forever), and at most `limit`
        entries are kept: the oldest are removed.
        """
        self._seconds = seconds
        self._limit = limit
        self._entries: OrderedDict[GoalID, tuple[float, T]] = OrderedDict()

    def __iter__(self) -> Iterator[T]:
        return (value for _, value in self._entries.values())

    def put(self, goal_id: GoalID, value: T, now: float, *, at_least_until: float = 0.0) -> None:
        """Add an entry, whose time begins now. Call `expire` afterwards to keep the limit."""
        self._entries.pop(goal_id, None)  # as in `put_until`, which another call would add to
        self._entries[goal_id] = (max(now + self._seconds, at_least_until), value)

    def put_until(self, goal_id: GoalID, value: T, until: float) -> None:
        """Add an entry that expires then. It is freed after all entries that were added before."""
        self._entries.pop(goal_id, None)  # an old entry would keep its place in the order
        self._entries[goal_id] = (until, value)

    def discard(self, goal_id: GoalID | None) -> T | None:
        """Remove the entry, if there is one, and return its value."""
        entry = None if goal_id is None else self._entries.pop(goal_id, None)
        return None if entry is None else entry[1]

    def get(self, goal_id: GoalID, now: float) -> T | None:
        """Return the value; None if it is missing, or has expired."""
        entry = self._entries.get(goal_id)
        return None if entry is None or entry[0] <= now else entry[1]

    def expire(self, now: float, most: float) -> list[T]:
        """Remove the oldest entries, at most so many, as long as the next one is too old or there
        are too many; return their values.
        """
        entries = self._entries
        gone: list[T] = []
        while entries and len(gone) < most:
            if len(entries) <= self._limit and next(iter(entries.values()))[0] > now:
                break
            gone.append(entries.popitem(last=False)[1][1])
        return gone

    @property
    def next_expiry(self) -> float:
        """The time at which the next entry expires; `math.inf` if none does."""
        # Those that are put expire in their order; one with a time of its own waits for its turn.
        return next(iter(self._entries.values()))[0] if self._entries else math.inf


class HeldBytes:
    """The bytes that are held of a goal: its payload, then its result and what its log has beside
    it. They count for as long as this object is referenced.
    """

    __slots__ = ("__weakref__", "_budget", "log", "share", "size")

    def __init__(self, budget: ByteBudget, size: int) -> None:
        """Count so many bytes from now on."""
        self._budget = budget
        budget.used += size
        self.size = size
        """The bytes that are counted."""
        self.share: Share | None = None
        """The share that they are part of, once the goal has ended."""
        self.log: ReferenceType[FeedbackLog[Any]] | None = None
        """The log of the goal, once the goal has ended; None if it had none since a restart."""

    def __del__(self) -> None:
        self._budget.used -= self.size
        if self.share is not None:
            self.share.leave(self)
        # In a cycle of garbage, the log of the goal may give its part back after this.
        self._budget, self.share = ByteBudget(0), None

    def resize(self, size: int) -> None:
        """Count so many bytes in place of those until now."""
        more, share = size - self.size, self.share
        self._budget.used += more
        self.size = size
        if share is not None:  # without a call, as each goal with feedback is here
            share.size += more
            share.results.size += more
            if id(self) in share.unread:
                share.unread_size += more
                share.results.unread_size += more

    def drop(self) -> None:
        """Have the result dropped by those that still follow the goal."""
        log = None if self.log is None else self.log()
        if log is not None:
            log.lose_result()


class Share:
    """The results of one client."""

    __slots__ = ("__weakref__", "name", "remembered", "results", "size", "unread", "unread_size")

    def __init__(self, results: KeptResults, name: str) -> None:
        self.results = results
        """All results of the server."""
        self.name = name
        """The name that belongs to the client's token; empty if it has none."""
        self.size = 0
        """The bytes of its results."""
        self.unread_size = 0
        """The part of them that is unread."""
        self.remembered: OrderedDict[GoalID, None] = OrderedDict()
        """The goals whose results are remembered, the oldest first."""
        self.unread: OrderedDict[int, ReferenceType[HeldBytes]] = OrderedDict()
        """The results that are unread, the oldest first."""

    def forget(self, goal_id: GoalID, held: HeldBytes) -> None:
        """Count a remembered result as unread; if it is not, it is about to leave."""
        del self.remembered[goal_id]
        self.unread[id(held)] = ref(held)
        self.unread_size += held.size
        self.results.unread_size += held.size

    def leave(self, held: HeldBytes) -> None:
        """Count a result no longer."""
        self.size -= held.size
        self.results.size -= held.size
        if self.unread.pop(id(held), None) is not None:
            self.unread_size -= held.size
            self.results.unread_size -= held.size

    def drop_oldest(self) -> None:
        """Drop the unread result that is the oldest."""
        _, oldest = self.unread.popitem(last=False)
        held = oldest()
        assert held is not None  # else it would have left
        self.unread_size -= held.size
        self.results.unread_size -= held.size
        held.drop()


class KeptResults:
    """The bytes of the results of all ended goals, by their owners."""

    def __init__(self, budget: ByteBudget) -> None:
        """Stay within this budget, which goals and feedback share."""
        self._budget = budget
        self.size = 0
        """The bytes of all results."""
        self.unread_size = 0
        """The part of them that is unread."""
        self._shares: WeakValueDictionary[bytes, Share] = WeakValueDictionary()
        self._newest: ReferenceType[HeldBytes] | None = None

    def add(self, goal_id: GoalID, sender: Sender, held: HeldBytes, size: int) -> None:
        """Remember the result of a goal that has ended: so many bytes."""
        share = self._shares.get(sender.owner)
        if share is None:
            share = self._shares[sender.owner] = Share(self, sender.name)
        self._budget.used += size - held.size
        held.size = size
        held.share = share
        share.remembered[goal_id] = None
        share.size += size
        self.size += size
        self._newest = ref(held)

    def busy_for(self, owner: bytes) -> str:
        """Return the reason for which a goal of that client is to be rejected; empty if none."""
        share, most = self._shares.get(owner), self._budget.limit // 2
        if share is None or share.unread_size <= most:
            return ""
        return (
            f"busy: its client has not read results of {share.unread_size} bytes, the limit is"
            f" {most}"
        )

    def next_to_forget(self) -> GoalID | None:
        """Return the goal that is to be forgotten, since the budget is used up; None if there is
        none, or if the loss of unread results has made room.
        """
        for _ in range(MOST_LOST):
            share = self._first_out()
            if share is None:
                return None
            if share.remembered:
                return next(iter(share.remembered))
            share.drop_oldest()
            if not self._budget.is_over:
                return None
        return None

    def _first_out(self) -> Share | None:
        """Return the share of which a result is to be given up; None if none may be."""
        shares = list(self._shares.values())
        of_names: Counter[str] = Counter()
        for share in shares:
            of_names[share.name] += share.size
        return max(
            filter(self._may_give, shares),
            key=lambda share: (of_names[share.name], share.size),
            default=None,
        )

    def _may_give(self, share: Share) -> bool:
        if share.remembered:
            return True
        if not share.unread or self.unread_size <= self._budget.limit // 2:
            return False
        return next(iter(share.unread.values())) != self._newest

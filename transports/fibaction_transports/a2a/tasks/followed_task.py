"""`FollowedTask`: one goal, as the server of A2A follows it for all agents.

Theory of operation
-------------------

One task reads the goal's stream to its end, and keeps the last updates: at most `MOST_KEPT`, and
`MOST_BYTES` of them. Each agent that follows the task reads them with a place of its own, so a
connection that breaks costs nothing: the agent comes back with the position of the last update that
it has seen, and what was lost on the way is read again.

The goal waits for slow agents, as it waits for its own client at every other door: while an agent
is half of what is kept behind, the stream is not read, and the server of the action holds the
executor. An agent whose connection is lost keeps its place until one comes back. The wait takes
`LONGEST_WAIT` seconds at most, after which the slow places are given up, and what is lost there
shows as a gap in the numbers.

What is kept here is not the truth: after a restart, or for a goal of another client, it begins with
what the server of the action still has.
"""

from __future__ import annotations

from collections import deque
from collections.abc import AsyncGenerator
from time import time
from typing import NamedTuple

import anyio

from fibaction.border.abc import FeedbackItem, GoalStream, Notifier
from fibaction.words.errors import ActionError
from fibaction.words.goals import GoalID, Outcome
from fibaction.words.statuses import GoalStatus
from fibaction_transports.a2a.tasks.feedback_position import START, FeedbackPosition
from fibaction_transports.a2a.tasks.skills import Skill

MOST_KEPT = 2000
"""Updates of a goal that are kept for agents that come back."""
MOST_BYTES = 2**18
"""Bytes of these updates; the newest one is kept in any case."""
LONGEST_WAIT = 10.0
"""Seconds that a goal waits for agents that read slowly, or whose connection is lost."""


class KeptUpdate(NamedTuple):
    """One update that is kept."""

    update: FeedbackItem | GoalStatus
    time: float
    """The time at which it was read, in seconds since 1970."""
    offset: int
    """Bytes of feedback that were read before it."""


class ReaderPlace:
    """The place of one agent that reads: the number of the next entry."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.is_left = False
        """True if its agent reads no more, and may come back."""


class FollowedTask:
    """One goal, with its last updates."""

    def __init__(self, skill: Skill, stream: GoalStream, context_id: str, *, own: bool) -> None:
        self.skill = skill
        self.context_id = context_id or str(stream.goal_id)
        """The context of the task: the one that the agent gave, else the ID of the goal."""
        self.own = own
        """True if it was sent here."""
        self.newest: FeedbackItem | None = None
        """The newest feedback."""
        self.outcome: Outcome[bytes] | None = None
        self.error: ActionError | None = None
        """The reason why the goal cannot be followed any more; it may go on."""
        self.updated_at = time()
        """The time of the newest update, in seconds since 1970."""
        self.ended = anyio.Event()
        """Set when there is an outcome, or an error."""
        self._stream = stream
        self._entries: deque[KeptUpdate] = deque()
        self._first = 0  # the number of the first entry that is kept
        self._bytes = 0  # of all feedback so far
        self._places: set[ReaderPlace] = set()
        self._news = Notifier()
        self._moved = Notifier()

    @property
    def goal_id(self) -> GoalID:
        """The goal's ID."""
        return self._stream.goal_id

    @property
    def stamp(self) -> int:
        """The time of the acceptance, in nanoseconds since 1970."""
        return self._stream.stamp

    @property
    def status(self) -> GoalStatus:
        """The newest status."""
        return self._stream.status if self.outcome is None else self.outcome.status

    async def follow(self) -> None:
        """Read the goal to its end."""
        with self._stream:
            try:
                async for update in self._stream:
                    self.updated_at = time()
                    if isinstance(update, Outcome):
                        self.outcome = update
                    else:
                        self._keep(update)
                        await self._wait_for_places()
            except ActionError as exc:
                self.error = exc
        self.ended.set()
        self._news.notify()

    async def has_read(self, number: int) -> None:
        """Wait until the feedback of that number was read, or the goal has ended."""
        while not self.ended.is_set() and (self.newest.number if self.newest else 0) < number:
            await self._news.wait()

    def _keep(self, update: FeedbackItem | GoalStatus) -> None:
        self._entries.append(KeptUpdate(update, self.updated_at, self._bytes))
        if isinstance(update, FeedbackItem):
            self.newest = update
            self._bytes += len(update.payload)
        entries = self._entries
        while len(entries) > MOST_KEPT or (
            len(entries) > 1 and self._bytes - entries[0].offset > MOST_BYTES
        ):
            entries.popleft()
            self._first += 1
        self._news.notify()

    # Agents that read

    async def updates(
        self, after: FeedbackPosition = START, *, statuses: bool = False
    ) -> AsyncGenerator[KeptUpdate, None]:
        """Iterate over the feedback after a position, and over the statuses from now on; with
        `statuses`, over all that are kept.

        It ends with the goal, or when the goal cannot be followed any more.
        """
        now = self._first if statuses else self._first + len(self._entries)
        self._forget_left()
        place = ReaderPlace(self._first)
        self._places.add(place)
        try:
            while True:
                while (entry := self._next(place)) is not None:
                    if _is_after(entry.update, after, is_new=place.number > now):
                        yield entry
                if self.ended.is_set():
                    break
                await self._news.wait()
            self._places.discard(place)
        finally:
            place.is_left = True
            self._moved.notify()

    def _next(self, place: ReaderPlace) -> KeptUpdate | None:
        place.number = max(place.number, self._first)
        if place.number == self._first + len(self._entries):
            return None
        entry = self._entries[place.number - self._first]
        place.number += 1
        self._moved.notify()
        return entry

    def _forget_left(self) -> None:
        self._places = {place for place in self._places if not place.is_left}
        self._moved.notify()

    async def _wait_for_places(self) -> None:
        """Wait until no agent is far behind, for a limited time."""
        with anyio.move_on_after(LONGEST_WAIT) as limit:
            while self._slow_places():
                await self._moved.wait()
        if limit.cancelled_caught:
            self._places -= self._slow_places()

    def _slow_places(self) -> set[ReaderPlace]:
        return {place for place in self._places if self._is_slow(place)}

    def _is_slow(self, place: ReaderPlace) -> bool:
        index = place.number - self._first
        if index >= len(self._entries):
            return False
        is_behind = len(self._entries) - index > MOST_KEPT // 2
        return is_behind or self._bytes - self._entries[max(index, 0)].offset > MOST_BYTES // 2


def _is_after(update: FeedbackItem | GoalStatus, after: FeedbackPosition, *, is_new: bool) -> bool:
    """Return whether an agent has yet to see an update: what it sees first tells the status."""
    if isinstance(update, FeedbackItem):
        return position(update) > after
    return is_new


def position(item: FeedbackItem) -> FeedbackPosition:
    """Return the position of a feedback."""
    return FeedbackPosition(attempt=item.attempt, number=item.number)

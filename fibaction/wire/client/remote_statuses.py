"""The statuses of all goals of a server, followed over a connection.

Theory of operation
-------------------

A server lets each connection follow the statuses of an action once. So all followers of an action
in this process share one call, the `StatusWatch`. The first follower opens it, and the last one
that leaves closes it.

The watch knows the newest status of each goal. A follower that comes later begins with these, and
then gets the changes, as the first one does: if part of the server's list is still to come, this
part counts as known, too. Before it begins, the server is asked for a sign, since it tells what has
changed by then before that: `AwaitServer`, or `AskPlaces` if a goal may wait, as no change tells
places. `OpenCalls` makes a new watch in place of one that has missed changes, because the server
has left some out: such a watch may know goals that the server has forgotten. The followers continue
with the new one.

On a new connection, and with a new watch, the server tells all goals again. They come after what a
follower has not read yet, and count as known once more.

The watch reads without waiting for its followers, since a slow one must not delay the others. Each
follower has a queue; in a full queue the oldest change gives way, and is counted as dropped.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from msgspec.structs import replace

from fibaction._runtime.text import LENGTH, excerpt, shortened
from fibaction.feeds.status_broadcast import StatusSubscription
from fibaction.wire.client.calls import Call, Credits, Post, unfitting
from fibaction.wire.errors import error_of
from fibaction.wire.messages import (
    Close,
    Failed,
    Finished,
    FromClient,
    GoalChanged,
    Watching,
    WatchStatus,
    labels_from,
    parent_from,
)
from fibaction.words.errors import ActionError
from fibaction.words.goals import GoalID, GoalInfo
from fibaction.words.statuses import GoalStatus

UNREAD = 10_000
"""Changes that wait for one follower, at most."""
MOST_GOALS = 100_000
"""Goals that one watch knows, at most: a server could tell of ever more."""


class StatusWatch(Call):
    """The call by which all followers of one action in this process get the statuses."""

    def __init__(self, call_id: int, action: str, window: int, post: Post) -> None:
        super().__init__(call_id)
        self._action = action
        self._post = post
        self._credit = Credits(call_id, window, post)
        self._followers: dict[RemoteStatuses, None] = {}
        self._goals: dict[GoalID, GoalInfo] = {}  # those that have ended are in that order
        self._unlisted = 0  # goals of the server's list that are still to come
        self._dropped = 0  # by the server, on this connection
        self._dropped_before = 0
        self._has_ended = False
        self._is_closed = False

    @property
    def is_complete(self) -> bool:
        """True if another follower may begin with what is known here."""
        return not (self.is_over or self._dropped or self.error)

    @property
    def has_accepted(self) -> bool:
        """True if a goal that is known here has not begun: it may wait in a queue."""
        return any(info.status is GoalStatus.ACCEPTED for info in self._goals.values())

    def set_places(self, waiting: Iterable[tuple[bytes, int, int]]) -> None:
        """Take the ID, the place and the length of the queue of all goals that wait."""
        places = {goal_id: (place, length) for goal_id, place, length in waiting}
        for goal_id, info in self._goals.items():
            if info.status is GoalStatus.ACCEPTED:
                place, length = places.get(goal_id, (0, 0))
                self._goals[goal_id] = replace(info, place=place, queue_length=length)

    @property
    def dropped(self) -> int:
        """The changes that the server has left out so far."""
        return self._dropped_before + self._dropped

    def follow(self) -> RemoteStatuses:
        """Return a new follower, which begins with the goals that are known."""
        active = [info for info in self._goals.values() if info.status.is_active]
        ended = [info for info in self._goals.values() if not info.status.is_active]
        statuses = RemoteStatuses(self, (*ended, *active), self._unlisted)
        self._followers[statuses] = None
        return statuses

    def take_over(self, other: StatusWatch) -> None:
        """Continue with the followers of another watch, which is closed."""
        self._followers = other._followers
        for statuses in self._followers:
            statuses.go_on_with(self)
        other._followers = {}
        other._close()

    def leave(self, statuses: RemoteStatuses) -> None:
        """Remove a follower; the last one closes the call."""
        self._followers.pop(statuses, None)
        if not (self._followers or self._is_closed):
            self._close()

    def _close(self) -> None:
        self._is_closed = self.is_over = True
        self._goals.clear()
        if not (self._has_ended or self.error):
            self._post(Close(self.id))

    def detach(self) -> None:
        """Forget what is known: the connection has ended, and the next one tells it again."""
        self.is_answered = False
        self._goals.clear()
        self._unlisted = 0

    def opening(self) -> FromClient:
        self._dropped_before, self._dropped = self.dropped, 0
        return WatchStatus(self.id, self._action, self._credit.restart(0))

    def on_message(self, message: Any) -> bool:
        if not self.is_answered and not isinstance(message, Watching | Failed):
            raise unfitting(message)
        if isinstance(message, GoalChanged):
            if not self._is_closed:
                self._take(message)
        elif isinstance(message, Watching):
            self.is_answered = True
            self._unlisted = message.known
            for statuses in self._followers:
                statuses.expect(message.known)
            self.news.notify()
        elif isinstance(message, Finished):
            self._has_ended = self.is_over = True
            for statuses in tuple(self._followers):
                statuses.end()
        elif isinstance(message, Failed):
            self.fail(error_of(message))
        else:
            raise unfitting(message)
        return isinstance(message, Finished | Failed)

    def fail(self, error: ActionError) -> None:
        super().fail(error)
        for statuses in tuple(self._followers):
            statuses.fail(error)

    def _take(self, message: GoalChanged) -> None:
        self._credit.grant()
        self._dropped = message.dropped
        self._unlisted = max(0, self._unlisted - 1)
        info = info_of(message)
        self._learn(info)
        for statuses in self._followers:
            statuses.put(info)

    def _learn(self, info: GoalInfo) -> None:
        goals = self._goals
        if not info.status.is_active:
            goals.pop(info.goal_id, None)
        if info.status is not GoalStatus.UNKNOWN:
            goals[info.goal_id] = info
            if len(goals) > MOST_GOALS:
                del goals[next(iter(goals))]


def info_of(message: GoalChanged) -> GoalInfo:
    """Return the goal that a message tells of."""
    return GoalInfo(
        GoalID(message.goal_id),
        message.stamp,
        message.status,
        message.feedback_count,
        excerpt(message.client),
        message.place,
        message.queue_length,
        message.attempt,
        parent_from(message.parent),
        began_at=message.began_at,
        ended_at=message.ended_at,
        reason=message.reason and shortened(message.reason, LENGTH),
        labels=labels_from(message.labels),
        worker=message.worker and excerpt(message.worker),
    )


class RemoteStatuses(StatusSubscription):
    """One follower of the statuses of all goals of a server."""

    def __init__(self, watch: StatusWatch, goals: Iterable[GoalInfo], unlisted: int) -> None:
        """Begin with these goals; so many more are to come."""
        super().__init__(goals, lambda _: self._watch.leave(self))
        self._watch = watch
        self._dropped_before = 0  # by other watches
        self._dropped_at_start = watch.dropped
        self.expect(unlisted)

    @property
    def dropped(self) -> int:
        by_server = self._watch.dropped - self._dropped_at_start
        return self._dropped_before + by_server + self._dropped

    async def listed(self) -> list[GoalInfo]:
        goals: dict[GoalID, GoalInfo] = {}
        while self._passed < self.known:  # it may be less after a connection was lost
            if self._items:
                info = self._take()
                goals[info.goal_id] = info
            elif not await self._wait():
                break
        return list(goals.values())

    def close(self) -> None:
        self._items.clear()
        self.end()

    # For the watch

    def expect(self, known: int) -> None:
        """Count so many goals that are told next, after what has come before, as known."""
        waiting = len(self._items) + known
        self.known = self._passed + waiting
        self._limit = UNREAD + min(waiting, MOST_GOALS)
        self._news.notify()

    def go_on_with(self, watch: StatusWatch) -> None:
        """Get the statuses from another watch from now on."""
        self._dropped_before = self.dropped - self._dropped
        self._watch, self._dropped_at_start = watch, watch.dropped

    def end(self) -> None:
        """End behind what has come."""
        super().close()

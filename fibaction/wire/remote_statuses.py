"""`RemoteStatuses`: the statuses of all goals of a server, followed over a connection."""

from __future__ import annotations

from collections import deque
from typing import Any

from fibaction._text import excerpt
from fibaction.abc import StatusStream
from fibaction.goals import GoalID, GoalInfo
from fibaction.wire.calls import Call, Credits, Post, unfitting
from fibaction.wire.codec import FromClient
from fibaction.wire.errors import error_of
from fibaction.wire.messages import Close, Failed, Finished, GoalChanged, Watching, WatchStatus


class RemoteStatuses(Call, StatusStream):
    """The statuses of all goals of a server, followed over a connection."""

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
        self._credit = Credits(call_id, window, post)

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
            raise unfitting(message)
        if isinstance(message, GoalChanged):
            self._credit.spend()
            self._dropped = message.dropped
            if not self._ended:
                info = GoalInfo(
                    GoalID(message.goal_id),
                    message.stamp,
                    message.status,
                    message.feedback_count,
                    excerpt(message.client),
                )
                self._items.append(info)
        elif isinstance(message, Watching):
            # On a new connection the server tells all goals again, after what has come before.
            self.known = self._taken + len(self._items) + message.known
            self._is_answered = True
        elif isinstance(message, Finished):
            self._ended = True
        elif isinstance(message, Failed):
            self.fail(error_of(message))
        else:
            raise unfitting(message)
        self.news.notify()
        return isinstance(message, Finished | Failed)

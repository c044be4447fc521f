"""`PastCall`: the call for a page of a history.

It is a `WatchStatus` that asks for the past. A server that does not know the history answers it as
one without: with the goals that it remembers. So what does not belong to the page is left out here,
and the call is closed when as many goals have come as the server has announced.
"""

from __future__ import annotations

from typing import Any

from fibaction.wire.client.calls import Call, unfitting
from fibaction.wire.client.remote_statuses import info_of
from fibaction.wire.codec import FromClient
from fibaction.wire.errors import error_of
from fibaction.wire.messages import (
    Failed,
    Finished,
    GoalChanged,
    Watching,
    WatchStatus,
    label_fields,
    past_fields,
)
from fibaction.words.goal_query import MOST_PAST, PastPage
from fibaction.words.goals import GoalInfo


class PastCall(Call):
    """A page of the history of an action."""

    def __init__(self, call_id: int, action: str, page: PastPage) -> None:
        super().__init__(call_id)
        self._page = page
        limit = min(page.limit, MOST_PAST)
        self._opening = WatchStatus(call_id, action, limit, past_fields(page), label_fields(page))
        self._left: int | None = None  # goals that are still to come; None before the answer
        self._infos: list[GoalInfo] = []

    def opening(self) -> FromClient:
        self._left, self._infos = None, []
        return self._opening

    def on_message(self, message: Any) -> bool:
        if isinstance(message, Failed):
            self.fail(error_of(message))
        elif isinstance(message, Watching) and self._left is None:
            self._left = min(message.known, self._opening.credit)
        elif isinstance(message, GoalChanged) and self._left:
            self._left -= 1
            self._infos.append(info_of(message))
        elif not (isinstance(message, Finished) and self._left is not None):
            raise unfitting(message)
        is_last = isinstance(message, Failed | Finished)
        if not self.is_answered and self.error is None and (is_last or self._left == 0):
            self.is_answered = True
            self.news.notify()
        return is_last

    @property
    def infos(self) -> list[GoalInfo]:
        """The goals that have come, in the order of the page."""
        infos = [info for info in self._infos if self._page.has(info)]
        return sorted(infos, key=place_of, reverse=self._page.newest_first)


def place_of(info: GoalInfo) -> tuple[int, bytes]:
    """Return the place of a goal in the order of acceptance."""
    return info.stamp, info.goal_id

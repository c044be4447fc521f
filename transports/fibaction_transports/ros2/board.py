"""The status list of an action server of ROS: what it says, and when it is published."""

from __future__ import annotations

from collections.abc import Callable

from fibaction._notify import Notifier
from fibaction.goals import GoalID, GoalInfo
from fibaction.states import GoalStatus
from fibaction_transports.ros2.cdr import pack_line, pack_statuses, status_of


class StatusBoard:
    """The goals that a server remembers, published whenever one has changed.

    Changes of one turn of the event loop are published together, because every list tells all
    goals. But no status of a goal is left out: a second change waits until the first is published.
    """

    def __init__(self, publish: Callable[[bytes], None]) -> None:
        self._publish = publish
        self._lines: dict[GoalID, bytes] = {}
        self._changed: set[GoalID] = set()
        self._news = Notifier()

    def __contains__(self, goal_id: GoalID) -> bool:
        return goal_id in self._lines

    def tell(self, info: GoalInfo) -> None:
        """A goal has another status; UNKNOWN takes it from the list. Nothing is told twice."""
        known = self._lines.get(info.goal_id)
        told: int = GoalStatus.UNKNOWN if known is None else status_of(known)
        if info.status == told or GoalStatus.UNKNOWN < info.status < told:
            return
        if info.goal_id in self._changed:
            self.flush()
        if info.status is GoalStatus.UNKNOWN:
            del self._lines[info.goal_id]
        else:
            self._lines[info.goal_id] = pack_line(info)
        self._changed.add(info.goal_id)
        self._news.notify()

    def clear(self) -> None:
        """There are no goals: whoever has them has been started anew, or is away."""
        if self._lines:
            self._changed.update(self._lines)
            self._lines.clear()
            self._news.notify()

    def flush(self) -> None:
        """Publish what has changed."""
        if self._changed:
            self._changed.clear()
            self._publish(pack_statuses(self._lines.values()))

    async def run(self) -> None:
        """Publish what changes, for ever."""
        while True:
            while not self._changed:
                await self._news.wait()
            self.flush()

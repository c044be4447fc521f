"""The status list of an action server, published and received.

Every message of the status topic lists all goals that the server remembers. `PublishedStatuses`
decides at the server when a list is sent. `ReceivedStatuses` finds at the client what has changed
since the list before.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator

import anyio

from fibaction.border.abc import Notifier
from fibaction.words.goals import GoalID, GoalInfo
from fibaction.words.statuses import TRANSITIONS, GoalStatus
from fibaction_transports.ros2.convert.status_bytes import (
    StatusLine,
    differences,
    info_of,
    lines_in,
    pack_line,
    pack_statuses,
    status_of,
)

REPEAT = 0.1
"""Seconds after an acceptance was answered at which the list is published again. A client of rclpy
drops the status of a goal whose acceptance it has yet to handle; then `ros2 action send_goal` would
not cancel at Ctrl-C, as it cancels only goals that it knows to be active."""


class PublishedStatuses:
    """The goals that a server remembers. The list is published when one of them has changed.

    Changes of one turn of the event loop are published together. No status of a goal is left out:
    a second change of a goal is added after the first has been published.
    """

    def __init__(self, publish: Callable[[bytes], None]) -> None:
        self._publish = publish
        self._lines: dict[GoalID, bytes] = {}
        self._changed: set[GoalID] = set()
        self._accepted: set[GoalID] = set()
        """The goals for which the list is to be published again."""
        self._news = Notifier()
        self._acceptances = Notifier()

    def __contains__(self, goal_id: GoalID) -> bool:
        return goal_id in self._lines

    def update(self, info: GoalInfo) -> None:
        """Set the status of a goal; UNKNOWN removes it. An earlier or equal status is ignored."""
        known = self._lines.get(info.goal_id)
        published: int = GoalStatus.UNKNOWN if known is None else status_of(known)
        if info.status == published or GoalStatus.UNKNOWN < info.status < published:
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
        """Remove all goals: the endpoint was restarted, or cannot be reached."""
        if self._lines:
            self._changed.update(self._lines)
            self._lines.clear()
            self._news.notify()

    def flush(self) -> None:
        """Publish the list now, if it has changed."""
        if self._changed:
            self._changed.clear()
            self._publish(pack_statuses(self._lines.values()))

    async def run(self) -> None:
        """Publish the changes until canceled."""
        while True:
            while not self._changed:
                await self._news.wait()
            self.flush()

    def repeat_later(self, goal_id: GoalID) -> None:
        """Publish the list once more after `REPEAT` seconds, if this goal is active then."""
        self._accepted.add(goal_id)
        self._acceptances.notify()

    async def repeat(self) -> None:
        """Publish the list again as told by `repeat_later`, until canceled. Goals that are added
        during a wait have their turn after the next one, so many goals cause few lists.
        """
        while True:
            while not self._accepted:
                await self._acceptances.wait()
            accepted, self._accepted = self._accepted, set()
            await anyio.sleep(REPEAT)
            lines = [self._lines[goal_id] for goal_id in accepted if goal_id in self._lines]
            if any(GoalStatus(status_of(line)).is_active for line in lines):
                self._changed.clear()
                self._publish(pack_statuses(self._lines.values()))


def _shortest_ways() -> dict[tuple[GoalStatus, GoalStatus], tuple[GoalStatus, ...]]:
    """Return the statuses from one to another; EXECUTING before CANCELING if both would do."""
    ways: dict[tuple[GoalStatus, GoalStatus], tuple[GoalStatus, ...]] = {}
    for start in GoalStatus:
        todo: deque[tuple[GoalStatus, ...]] = deque([(start,)])
        while todo:
            way = todo.popleft()
            for (before, _), after in TRANSITIONS.items():
                if before is way[-1] and (start, after) not in ways:
                    ways[start, after] = (*way[1:], after)
                    todo.append((*way, after))
    return ways


_WAYS = _shortest_ways()


class ReceivedStatuses:
    """The goals of the last status list that was received.

    Readers get the list in its latest version only, so some statuses are never seen. The statuses
    that a goal must have had are reported anyway, so that every change is a legal one.
    """

    def __init__(
        self, stamp_of: Callable[[bytes, int], int] = lambda goal_id, stamp: stamp
    ) -> None:
        """`stamp_of` translates the stamp of a goal from ROS."""
        self._stamp_of = stamp_of
        self._infos: dict[bytes, GoalInfo] = {}
        self._lines = b""
        self._first = True

    def __iter__(self) -> Iterator[GoalInfo]:
        return iter(self._infos.values())

    def get(self, goal_id: bytes) -> GoalInfo | None:
        """Return the last known status of a goal; None if the list does not have the goal."""
        return self._infos.get(goal_id)

    @property
    def has_come(self) -> bool:
        """True if a list has been received."""
        return not self._first

    def clear(self) -> None:
        """Forget the list: its server has gone, and the next list is another server's."""
        self._infos.clear()
        self._lines = b""
        self._first = True

    def update(self, message: bytes) -> list[GoalInfo]:
        """Take a list, and return the changes in order; UNKNOWN for a goal that has left the list.

        Raises:
            ProtocolError: The message is not a status list.
        """
        lines = lines_in(message)
        gone, new = differences(self._lines, lines)
        changed = [self._info(line) for line in new]
        steps = [step for info in changed for step in self._steps(info)]
        left = {line[0] for line in gone} - {line[0] for line in new}
        for goal_id in left & self._infos.keys():  # an invalid list may have a goal twice
            info = self._infos.pop(goal_id)
            steps.append(GoalInfo(info.goal_id, info.stamp, GoalStatus.UNKNOWN))
        self._infos.update((info.goal_id, info) for info in changed)
        self._lines = lines
        self._first = False
        return steps

    def _info(self, line: StatusLine) -> GoalInfo:
        info = info_of(line)
        return GoalInfo(info.goal_id, self._stamp_of(info.goal_id, info.stamp), info.status)

    def _steps(self, info: GoalInfo) -> Iterator[GoalInfo]:
        before = self._infos.get(info.goal_id)
        if before is not None:
            way = _WAYS.get((before.status, info.status), (info.status,))
        elif self._first:
            way = (info.status,)  # earlier statuses are older than this client
        else:
            way = (GoalStatus.ACCEPTED, *_WAYS.get((GoalStatus.ACCEPTED, info.status), ()))
        return (GoalInfo(info.goal_id, info.stamp, status) for status in way)

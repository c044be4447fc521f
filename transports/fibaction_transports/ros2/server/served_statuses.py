"""The status list that the server of an action publishes: every message has all goals that the
server remembers.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import anyio
from anyio.abc import TaskGroup

from fibaction.border.abc import Notifier
from fibaction.border.event_loop import loop_clock
from fibaction.words.goals import GoalID, GoalInfo
from fibaction.words.statuses import GoalStatus
from fibaction_transports.ros2.convert.status_bytes import pack_line, pack_statuses, status_of
from fibaction_transports.ros2.node.stamps import ServedStamps

REPEAT = 0.1
"""Seconds after an acceptance was answered at which the list is published again. A client of rclpy
drops the status of a goal whose acceptance it has yet to handle; then `ros2 action send_goal` would
not cancel at Ctrl-C, as it cancels only goals that it knows to be active."""
SECONDS_PER_LINE = 1e-4
"""Seconds that each goal of a list takes of the time for lists. A client of rclpy needs some 5 us
of its processor to read one."""
LONGEST_PAUSE = 0.02
"""Seconds that a list takes at most, so a change is told within them."""
BURST = 2 * LONGEST_PAUSE
"""Seconds by which lists may be ahead of their time: a goal after a pause has a list for each of
its statuses at once, however many goals the list has."""


class ServedStatuses:
    """The goals that a server remembers. The list is published when one of them has changed.

    Changes of one turn of the event loop are published together, and a second change of a goal is
    added after the first has been published. A list has all goals, so with many goals most of the
    work at both ends would be lists. So each takes time by its length, as in a leaky bucket. When
    lists are ahead of their time, changes wait for up to `LONGEST_PAUSE` seconds, and only the last
    status of each goal is published: a client that keeps the last list sees no more in any case.
    """

    def __init__(self, publish: Callable[[bytes], None], stamps: ServedStamps) -> None:
        """`publish` is called with each list."""
        self.stamps = stamps
        """The stamps of the goals in ROS."""
        self.published_at = -math.inf
        """The time at which a list was published last."""
        self._due = -math.inf
        """The time from which the next list may be published."""
        self._publish_bytes = publish
        self._time = loop_clock()
        self._lines: dict[GoalID, bytes] = {}
        self._changed: set[GoalID] = set()
        self._leaving: list[GoalInfo] = []
        """The goals that leave the list when the next one has told their end."""
        self._accepted: set[GoalID] = set()
        """The goals for which the list is to be published again."""
        self._news = Notifier()
        self._acceptances = Notifier()

    def start(self, tasks: TaskGroup, action: str) -> None:
        """Publish the list without goals, so that clients need not wait for a list, and then each
        change.
        """
        self._publish()
        tasks.start_soon(self.run, name=f"statuses of {action}")
        tasks.start_soon(self.repeat, name=f"repeated statuses of {action}")

    def __contains__(self, goal_id: GoalID) -> bool:
        return goal_id in self._lines

    def update(self, info: GoalInfo) -> None:
        """Set the status of a goal; UNKNOWN removes it. An earlier or equal status is ignored."""
        goal_id, status = info.goal_id, info.status
        known = self._lines.get(goal_id)
        published: int = GoalStatus.UNKNOWN if known is None else status_of(known)
        if status == published or GoalStatus.UNKNOWN < status < published:
            return
        if goal_id in self._changed:
            self.publish_if_due()
        if status is GoalStatus.UNKNOWN and goal_id in self._changed:
            self._leaving.append(info)
            return
        if status is GoalStatus.UNKNOWN:
            self.stamps.forget(goal_id)
            del self._lines[goal_id]
        else:
            self._lines[goal_id] = pack_line(self.in_ros(info))
        self._changed.add(goal_id)
        self._news.notify()

    def in_ros(self, info: GoalInfo) -> GoalInfo:
        """Return the status of a goal with its stamp in ROS."""
        return GoalInfo(info.goal_id, self.stamps.to_ros(info.goal_id, info.stamp), info.status)

    def clear(self) -> None:
        """Remove all goals: the endpoint was restarted, or cannot be reached."""
        self.stamps.clear()
        self._leaving.clear()
        if self._lines:
            self._changed.update(self._lines)
            self._lines.clear()
            self._news.notify()

    def publish_if_due(self) -> None:
        """Publish the list now, if it has changed and no other was published just before; `run`
        publishes it otherwise.
        """
        if self._changed and self._time() >= self._due:
            self._publish()

    def flush(self) -> None:
        """Publish the list now, if it has changed."""
        if self._changed:
            self._publish()

    def _publish(self) -> None:
        self._changed.clear()
        now = self.published_at = self._time()
        pause = min(SECONDS_PER_LINE * len(self._lines), LONGEST_PAUSE)
        self._due = max(self._due, now - BURST) + pause
        self._publish_bytes(pack_statuses(self._lines.values()))
        leaving, self._leaving = self._leaving, []
        for info in leaving:
            self.update(info)

    async def run(self) -> None:
        """Publish the changes until canceled."""
        while True:
            while not self._changed:
                await self._news.wait()
            if self._time() < self._due:
                await anyio.sleep_until(self._due)
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
                self._publish()

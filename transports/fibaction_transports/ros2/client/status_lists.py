"""The status lists that a client has received: what has changed in each, and the streams that
follow them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator

import anyio

from fibaction.border.abc import Notifier
from fibaction.border.peer_text import clean_logger
from fibaction.feeds.status_broadcast import StatusSubscription
from fibaction.words.errors import ConnectionLost, ProtocolError
from fibaction.words.goals import GoalInfo
from fibaction.words.statuses import TRANSITIONS, GoalStatus
from fibaction_transports.ros2.convert.status_bytes import (
    StatusLine,
    differences,
    info_of,
    lines_in,
)

FIRST_LIST = 1.0
"""Seconds to wait for the first status list. It may never come: a server of rclpy or rclcpp that
has never had a goal has published none."""

logger = clean_logger("fibaction.ros2")


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
        changed = list(self._infos_of(new))
        steps = list[GoalInfo]()
        for info in changed:
            steps += self._steps(info)
        left = {line[0] for line in gone} - {line[0] for line in new}
        for goal_id in left & self._infos.keys():  # an invalid list may have a goal twice
            info = self._infos.pop(goal_id)
            steps.append(GoalInfo(info.goal_id, info.stamp, GoalStatus.UNKNOWN))
        for info in changed:
            self._infos[info.goal_id] = info
        self._lines = lines
        self._first = False
        return steps

    def _infos_of(self, lines: Iterable[StatusLine]) -> Iterator[GoalInfo]:
        """Yield the goals of lines. A line with a status that ROS does not have is left out: it
        says nothing of its goal.
        """
        for line in lines:
            try:
                info = info_of(line)
            except ProtocolError as exc:
                logger.warning("a goal is left out: %s", exc)
                continue
            stamp = self._stamp_of(info.goal_id, info.stamp)
            yield GoalInfo(info.goal_id, stamp, info.status)

    def _steps(self, info: GoalInfo) -> list[GoalInfo]:
        before = self._infos.get(info.goal_id)
        if before is not None:
            way = _WAYS.get((before.status, info.status), (info.status,))
        elif self._first:
            way = (info.status,)  # earlier statuses are older than this client
        else:
            way = (GoalStatus.ACCEPTED, *_WAYS.get((GoalStatus.ACCEPTED, info.status), ()))
        if way == (info.status,):
            return [info]
        return [GoalInfo(info.goal_id, info.stamp, status) for status in way]


class StatusLists:
    """The statuses of all goals of an action, as its servers have listed them last."""

    def __init__(self, stamp_of: Callable[[bytes, int], int]) -> None:
        """`stamp_of` translates the stamp of a goal from ROS."""
        self.known = ReceivedStatuses(stamp_of)
        self.servers: frozenset[bytes] = frozenset()
        """The servers when the last list came: one of them has sent it."""
        self._streams: list[StatusSubscription] = []
        self._news = Notifier()

    def take(self, message: bytes, servers: frozenset[bytes]) -> list[GoalInfo]:
        """Take a list, tell the streams, and return the changes in order.

        Raises:
            ProtocolError: The message is not a status list.
        """
        self.servers = servers
        changes = self.known.update(message)
        for info in changes:
            for stream in self._streams:
                stream.put(info)
        self._news.notify()
        return changes

    async def subscribe(self) -> StatusSubscription:
        """Follow the statuses, from the first list on if one comes soon."""
        with anyio.move_on_after(FIRST_LIST):
            while not self.known.has_come:
                await self._news.wait()
        stream = StatusSubscription(self.known, self._unsubscribe)
        self._streams.append(stream)
        return stream

    def _unsubscribe(self, stream: StatusSubscription) -> None:
        if stream in self._streams:
            self._streams.remove(stream)

    @property
    def are_followed(self) -> bool:
        """True if there is a stream."""
        return bool(self._streams)

    def forget(self) -> None:
        """Forget the list: the next one is another server's."""
        self.servers = frozenset()
        self.known.clear()

    def fail(self, error: ConnectionLost) -> None:
        """End the streams with an error."""
        for stream in self._streams:
            stream.fail(error)
        self._streams.clear()

"""`StatusLists`: the status lists that a client has received, and the streams that follow them."""

from __future__ import annotations

from collections.abc import Callable

import anyio

from fibaction.border.abc import Notifier
from fibaction.feeds.status_broadcast import StatusSubscription
from fibaction.words.errors import ConnectionLost
from fibaction.words.goals import GoalInfo
from fibaction_transports.ros2.node.status_list import ReceivedStatuses

FIRST_LIST = 1.0
"""Seconds to wait for the first status list. It may never come: a server of rclpy or rclcpp that
has never had a goal has published none."""


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

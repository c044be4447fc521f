"""The number of feedback messages of each goal, which servers of fibaction publish when it ends.

A client of ROS cannot tell whether it has all feedback: the messages carry no numbers, and what the
middleware sends again to a new reader may arrive after the result. So a server of fibaction tells
the number on a topic of its own, beside those of the action. Its name is hidden, so that the tools
of ROS do not list it, and only clients of fibaction subscribe to it, if a server publishes it.

A message is an `rcl_interfaces/msg/Parameter`, a type that every node of rclpy has: its name is the
goal's ID, its value the number. It is published before the result, and the topic keeps the last
messages for a client that is connected later.
"""

from __future__ import annotations

from collections.abc import Callable

from fibaction.goals import GoalID
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.names import count_topic
from fibaction_transports.ros2.node import RosNode
from fibaction_transports.ros2.rcl import ParameterMessage, deserialize, raw
from fibaction_transports.ros2.waitable import Messages


class PublishedCounts:
    """The numbers of feedback messages, as a server publishes them."""

    def __init__(self, ros: RosNode, action: str) -> None:
        """Make the publisher.

        Raises:
            TransportError: ROS does not allow it.
        """
        self._ros = ros
        self._publisher = ros.make(
            raw.Publisher, ParameterMessage, count_topic(ros.node, action), qos.counts()
        )
        self._message = ParameterMessage()
        self._message.value.type = 2  # PARAMETER_INTEGER

    def publish(self, goal_id: GoalID, count: int) -> None:
        """Publish the number of feedback messages of a goal that has ended."""
        self._message.name = str(goal_id)
        self._message.value.integer_value = count
        self._ros.attempt(self._publisher.publish, self._message)


class ReceivedCounts:
    """The numbers of feedback messages, as a client receives them."""

    def __init__(self, ros: RosNode, action: str, take: Callable[[GoalID, int], None]) -> None:
        """`take` is called with a goal's ID and its number of feedback messages."""
        self._ros = ros
        self._topic = count_topic(ros.node, action)
        self._take = take
        self._servers: frozenset[bytes] = frozenset()
        self._has_subscribed = False
        self._are_published = False

    def come_from(self, servers: frozenset[bytes]) -> bool:
        """Return whether the only one of these servers publishes the numbers, and see to it that
        they arrive. Of several servers, each would publish a number for the same goal.
        """
        if servers != self._servers or not self._are_published:
            self._servers = servers
            look = self._ros.node.count_publishers
            found: int = self._ros.attempt(look, self._topic, otherwise=0)
            self._are_published = found == len(servers) == 1
            if self._are_published and not self._has_subscribed:
                self._ros.attempt(self._subscribe)
        return self._are_published

    def _subscribe(self) -> None:
        subscription = self._ros.make(raw.Subscription, ParameterMessage, self._topic, qos.counts())
        # First, so that a number that arrives together with the result is known before it.
        self._ros.listen(Messages(subscription, ParameterMessage, self._take_one), first=True)
        self._has_subscribed = True

    def _take_one(self, item: tuple[bytes, bytes]) -> None:
        found = deserialize(item[0], ParameterMessage)
        self._take(GoalID.parse(found.name), found.value.integer_value)

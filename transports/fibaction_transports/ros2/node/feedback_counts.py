"""The number of feedback messages of each goal, which servers of fibaction publish when it ends.

A client of ROS cannot tell whether it has all feedback: the messages carry no numbers, and what the
middleware sends again to a new reader may arrive after the result. So a server of fibaction tells
the number on a topic of its own, in addition to those of the action. Its name is hidden, so that
the tools of ROS do not list it, and only clients of fibaction subscribe to it, if a server
publishes it.

A message is an `rcl_interfaces/msg/Parameter`, a type that every node of rclpy has: its name is the
goal's ID, its value the number. It is published before the result, and the topic keeps the last
messages for a client that is connected later.

ROS may not allow the topic: with SROS 2, a policy for a plain action does not have it. Then goals
run as with servers of rclpy.
"""

from __future__ import annotations

from collections.abc import Callable

from fibaction.words.errors import ProtocolError, TransportError
from fibaction.words.goals import GoalID
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.convert.status_bytes import pack_count
from fibaction_transports.ros2.names import count_topic
from fibaction_transports.ros2.node.parts import TopicPublisher
from fibaction_transports.ros2.node.ros_node import RosNode


class PublishedCounts:
    """The numbers of feedback messages, as a server publishes them."""

    def __init__(self, ros: RosNode, action: str) -> None:
        self._publisher: TopicPublisher | None = None
        topic = count_topic(ros.resolve, action)
        try:
            self._publisher = ros.publisher(topic, ros.types.Parameter, qos.counts())
        except TransportError as exc:
            ros.warn(f"{action}: clients are not told how many feedback messages a goal had: {exc}")

    def publish(self, goal_id: GoalID, count: int) -> None:
        """Publish the number of feedback messages of a goal that has ended."""
        if self._publisher is not None:
            self._publisher.publish_bytes(pack_count(goal_id, count))


class ReceivedCounts:
    """The numbers of feedback messages, as a client receives them."""

    def __init__(self, ros: RosNode, action: str, take: Callable[[GoalID, int], None]) -> None:
        """`take` is called with a goal's ID and its number of feedback messages."""
        self._ros = ros
        self._topic = count_topic(ros.resolve, action)
        self._take = take
        self._servers: frozenset[bytes] = frozenset()
        self._has_subscribed = False
        self._is_allowed = True
        self._are_published = False

    def come_from(self, servers: frozenset[bytes]) -> bool:
        """Subscribe to the numbers if there is one server and it publishes them, and return whether
        that is so. If there were several, each would publish a number for the same goal.
        """
        if servers != self._servers or not self._are_published:
            self._servers = servers
            found = self._ros.count_publishers(self._topic)
            self._are_published = found == len(servers) == 1
            if self._are_published and not self._has_subscribed:
                self._subscribe()
        return self._are_published and self._is_allowed

    def _subscribe(self) -> None:
        self._has_subscribed = True
        try:
            self._listen()
        except TransportError as exc:
            if self._ros.is_up:
                self._is_allowed = False
                self._ros.warn(f"lost feedback is not counted: {exc}")

    def _listen(self) -> None:
        # First, so that a number that arrives together with the result is known before it.
        self._ros.subscription(
            self._topic, self._ros.types.Parameter, qos.counts(), self._take_one, is_first=True
        )

    def _take_one(self, message: bytes, publisher: bytes) -> None:
        found = self._ros.types.decode(message, self._ros.types.Parameter)
        try:
            goal_id = GoalID.parse(found.name)
        except ValueError as exc:
            raise ProtocolError(f"invalid number of feedback messages: {exc}") from exc
        self._take(goal_id, found.value.integer_value)

"""A publisher of a topic."""

from __future__ import annotations

from typing import Any, Generic, TypeVar

import anyio

from fibaction.border.streams import Closing
from fibaction_transports.ros2.messaging.forms import MessageForm
from fibaction_transports.ros2.node.ros_node import RosNode, TopicType
from fibaction_transports.ros2.qos import EndQos

T = TypeVar("T")


class Publisher(Closing, Generic[T]):
    """A publisher of a topic. Messages leave in the order in which they are published."""

    def __init__(
        self, ros: RosNode, topic: str, topic_type: TopicType, form: MessageForm, qos: EndQos
    ) -> None:
        """Announce it; `Node.publisher` does it."""
        self.topic = topic
        """The full name of the topic."""
        self._ros = ros
        self._form = form
        self._part = ros.publisher(topic, topic_type.message, qos)
        self._is_closed = False

    async def publish(self, message: T | dict[str, Any]) -> None:
        """Publish a message, or a dict with its fields; those that it leaves out have the defaults
        of ROS. It does not wait for readers.

        Raises:
            ValueError: It does not fit the type; the text names the field.
            ConnectionLost: The node can send nothing any more.
            anyio.ClosedResourceError: The publisher was closed.
        """
        if self._is_closed:
            raise anyio.ClosedResourceError
        self._ros.raise_if_lost()
        try:
            self._part.publish(self._form.to_ros(message))
        except ValueError as exc:
            raise ValueError(f"{self.topic}: {exc}") from exc
        await anyio.lowlevel.checkpoint()  # a loop that publishes lets others have their turns

    def reader_count(self) -> int:
        """Return the number of subscriptions that are connected."""
        return self._part.reader_count()

    async def wait_for_reader(self, timeout: float | None = None) -> None:
        """Wait until a subscription is connected; for ever without a timeout in seconds.

        Raises:
            TimeoutError: There was none in time.
            ConnectionLost: The node can send nothing any more.
        """
        with anyio.move_on_after(timeout):
            await self._ros.until(self._part.reader_count)
            return
        raise TimeoutError(f"nobody has subscribed to {self.topic} in {timeout:g} s")

    def close(self) -> None:
        """Remove the publisher from the graph. Closing twice does nothing."""
        if not self._is_closed:
            self._is_closed = True
            self._ros.remove(self._part)

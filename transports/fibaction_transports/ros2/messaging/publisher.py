"""A publisher of a topic."""

from __future__ import annotations

import math
from collections.abc import Callable
from time import perf_counter
from typing import Any, Final, Generic, TypeVar

import anyio

from fibaction.border.streams import Closing
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.messaging.forms import MessageForm
from fibaction_transports.ros2.node.ros_node import RosNode, TopicType
from fibaction_transports.ros2.qos import EndQos

TURN: Final = 0.001
"""Seconds after which a loop that publishes lets other tasks have their turn."""

T = TypeVar("T")


class Publisher(Closing, Generic[T]):
    """A publisher of a topic. Messages leave in the order in which they are published."""

    def __init__(
        self, ros: RosNode, topic: str, topic_type: TopicType, form: MessageForm, end_qos: EndQos
    ) -> None:
        """Announce it; `Node.publisher` does it."""
        self.topic = topic
        """The full name of the topic."""
        self._ros = ros
        self._form = form
        self._qos = end_qos
        self._part = ros.publisher(topic, topic_type.message, end_qos)
        self._is_closed = False
        self._yielded = -math.inf
        """The time at which others had their turn here."""

    async def publish(self, message: T | dict[str, Any], *, timeout: float | None = None) -> None:
        """Publish a message, or a dict with its fields; those that it leaves out have the defaults
        of ROS.

        It does not wait for readers, which may miss messages if they are slow, unless the
        publisher was made with `qos="keep_all"`: then it waits while reliable readers have not
        taken the last `depth` messages. A reader that takes none for ten seconds is given up.

        Raises:
            ValueError: It does not fit the type; the text names the field.
            TimeoutError: Readers have not taken enough in the seconds of the timeout.
            ConnectionLost: The node can send nothing any more.
            anyio.ClosedResourceError: The publisher was closed.
        """
        if self._is_closed:
            raise anyio.ClosedResourceError
        self._ros.raise_if_lost()
        made = self.message(message)
        if not self._part.has_room():
            await self._until(self._part.has_room, timeout, "readers have taken too little of")
        if self._is_closed:
            raise anyio.ClosedResourceError
        self._part.publish_alone(made)
        # Not after each message: a turn costs as much as ten of them. The time between them counts,
        # since the loop may work that long without any turn of others.
        if perf_counter() - self._yielded > TURN:
            await anyio.lowlevel.checkpoint()
            self._yielded = perf_counter()

    def message(self, value: T | dict[str, Any]) -> Any:
        """Return a value as the message that is published.

        Raises:
            ValueError: It does not fit the type; the text names the field.
        """
        try:
            return self._form.to_ros(value)
        except ValueError as exc:
            raise ValueError(f"{self.topic}: {exc}") from exc

    def reader_count(self) -> int:
        """Return the number of subscriptions that are connected."""
        return self._part.reader_count()

    async def wait_for_reader(self, timeout: float | None = None, *, count: int = 1) -> None:
        """Wait until so many subscriptions are connected; for ever without a timeout in seconds.

        Raises:
            TimeoutError: There were fewer in time; the text says whose QoS does not match.
            ConnectionLost: The node can send nothing any more.
        """
        what = "nobody has" if count == 1 else f"fewer than {count} have"
        await self._until(
            lambda: self._part.reader_count() >= count, timeout, f"{what} subscribed to"
        )

    async def _until(self, look: Callable[[], object], timeout: float | None, problem: str) -> None:
        with anyio.move_on_after(timeout):
            await self._ros.until(look)
            return
        raise TimeoutError(f"{problem} {self.topic} in {timeout:g} s{self._mismatch()}")

    def _mismatch(self) -> str:
        """Return what keeps readers away: another type, or the first difference of QoS, as both
        sides have it.
        """
        ends = self._ros.subscriptions(self.topic)
        if others := self._form.other_types(ends):
            return f": its subscriptions have the type {others}"
        for end in ends if self._ros.matches_by_qos else ():
            if told := qos.difference(self._qos, end.qos):
                offers, wants = told
                return f": this publisher offers {offers}, and {end.node or 'a node'} wants {wants}"
        return ""

    def close(self) -> None:
        """Remove the publisher from the graph. Closing twice does nothing."""
        if not self._is_closed:
            self._is_closed = True
            self._ros.remove(self._part)

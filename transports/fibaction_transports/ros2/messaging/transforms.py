"""The transforms of a robot, read from `/tf` and `/tf_static` by a node."""

from __future__ import annotations

from functools import partial
from typing import Final

import anyio

from fibaction.border.abc import Notifier
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.words.errors import ProtocolError
from fibaction_transports.ros2.messaging.transform_buffer import Transform, TransformBuffer
from fibaction_transports.ros2.node.ros_node import RosNode
from fibaction_transports.ros2.qos import EndQos

_TYPE: Final = "tf2_msgs/msg/TFMessage"
_DEPTH: Final = 100
"""Messages that wait for the event loop: the depth of tf2."""

logger = clean_logger("fibaction.ros2")


class TransformReader:
    """The frames of a graph, which are read as long as the node is open."""

    def __init__(self, ros: RosNode) -> None:
        """Subscribe to both topics.

        Raises:
            TransportError: The type of the messages is not known here.
            ConnectionLost: The node was closed.
        """
        ros.raise_if_lost()
        self._ros = ros
        self._type = ros.types.topic_type(_TYPE).message
        self._buffer = TransformBuffer()
        self._news = Notifier()
        self._era = ros.clock.era
        ros.on_loss(lambda error: self._news.notify())
        for topic, durability in (("/tf_static", "transient_local"), ("/tf", "volatile")):
            qos = EndQos(durability=durability, depth=_DEPTH)
            take = partial(self._take, topic == "/tf_static")
            ros.subscription(ros.resolve(topic), self._type, qos, take)

    def _take(self, is_static: bool, payload: bytes, publisher: bytes) -> None:
        try:
            message = self._ros.types.decode(payload, self._type)
        except ProtocolError as exc:
            logger.error("a message of /tf cannot be read: %s", excerpt(str(exc)))
            return
        if self._era != self._ros.clock.era:  # a simulation began anew
            self._era = self._ros.clock.era
            self._buffer.forget_moving()
        for one in message.transforms:
            stamp, moved = one.header.stamp, one.transform.translation
            turned = one.transform.rotation
            self._buffer.add(
                one.child_frame_id,
                one.header.frame_id,
                stamp.sec * 10**9 + stamp.nanosec,
                Transform(moved.x, moved.y, moved.z, turned.x, turned.y, turned.z, turned.w),
                is_static=is_static,
            )
        self._news.notify()

    async def look_up(
        self, frame: str, target: str, at: float | None, timeout: float | None
    ) -> Transform:
        """Wait until a pose is known; see `Node.transform`."""
        time = None if at is None else round(at * 10**9)
        problem = ""
        with anyio.move_on_after(timeout):
            while True:
                try:
                    return self._buffer.look_up(frame, target, time)
                except LookupError as exc:
                    problem = str(exc)
                self._ros.raise_if_lost()
                await self._news.wait()
        raise TimeoutError(f"no transform of {frame} to {target} in {timeout:g} s: {problem}")

"""The transforms of a robot, read from `/tf` and `/tf_static` by a node."""

from __future__ import annotations

from functools import partial
from typing import Final

import anyio

from fibaction.border.abc import Notifier
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.words.errors import ProtocolError
from fibaction_transports.ros2.messaging.transform_buffer import Transform, TransformBuffer
from fibaction_transports.ros2.node.ros_node import RosClock, RosNode
from fibaction_transports.ros2.qos import EndQos

_TYPE: Final = "tf2_msgs/msg/TFMessage"
CLOCK_PAUSE: Final = 0.02
"""Seconds between two looks at the clock of a simulation, which may be faster than the machine's.
"""
_DEPTH: Final = 100
"""Messages that wait for the event loop: the depth of tf2."""

logger = clean_logger("fibaction.ros2")


class Patience:
    """A timeout by the clock of a node, as that of tf2: while a simulation stands still, it does
    not run. Until the time of the simulation is known, it runs by the clock of the machine.
    """

    def __init__(self, clock: RosClock, seconds: float) -> None:
        self._clock = clock
        self._seconds = seconds
        self._begin()

    def _begin(self) -> None:
        self._era = self._clock.era
        self._began = self._clock.now()
        self._end = anyio.current_time() + self._seconds

    def left(self) -> float:
        """Return for how many seconds of the machine one may wait until the next call; 0 if the
        time is over.
        """
        now = self._clock.now()
        if self._clock.is_the_machines or not now:
            return max(0.0, self._end - anyio.current_time())
        if self._era != self._clock.era or not self._began:  # a simulation began, or began anew
            self._begin()
        left = self._seconds - (now - self._began) / 10**9
        return min(left, CLOCK_PAUSE) if left > 0 else 0.0


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
        patience = None if timeout is None else Patience(self._ros.clock, timeout)
        while True:
            try:
                return self._buffer.look_up(frame, target, time)
            except LookupError as exc:
                problem = str(exc)
            self._ros.raise_if_lost()
            left = None if patience is None else patience.left()
            if left == 0:
                told = f"no transform of {frame} to {target} in {timeout:g} s"
                raise TimeoutError(f"{told}: {problem}")
            with anyio.move_on_after(left):
                await self._news.wait()

"""The frames of a robot and how they lie to each other, read from `/tf` and `/tf_static`.

The rules are those of tf2 (https://docs.ros.org/en/rolling/Concepts/Intermediate/About-Tf2.html):
each frame has one parent; between two times, a position is interpolated linearly and a rotation
along the shorter arc; nothing is told of a time before the first or after the last one that is
kept.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from functools import partial
from typing import Final, NamedTuple

import anyio

from fibaction.border.abc import Notifier
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.words.errors import ProtocolError
from fibaction_transports.ros2.node.ros_node import RosClock, RosNode
from fibaction_transports.ros2.qos import EndQos

KEPT: Final = 10 * 10**9
"""Nanoseconds for which the past of a frame is kept, as in tf2."""
MOST_FRAMES: Final = 10_000
"""Frames that are known; more are left out."""
MOST_TIMES: Final = 10_000
"""Times of one frame that are kept."""
_SAME: Final = 1 - 1e-9
"""The cosine of an angle between rotations that is too small to divide by its sine."""


class Transform(NamedTuple):
    """The pose of one frame in another one: a translation, and a rotation as a unit quaternion."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    qx: float = 0.0
    qy: float = 0.0
    qz: float = 0.0
    qw: float = 1.0

    @property
    def yaw(self) -> float:
        """The angle around the vertical axis, in radians from -pi to pi."""
        return math.atan2(
            2 * (self.qw * self.qz + self.qx * self.qy), 1 - 2 * (self.qy**2 + self.qz**2)
        )

    def apply(self, x: float, y: float, z: float = 0.0) -> tuple[float, float, float]:
        """Return a point of the inner frame in the coordinates of the outer one."""
        turned = _product(_product(self[3:], (x, y, z, 0.0)), _conjugate(self[3:]))
        return (turned[0] + self.x, turned[1] + self.y, turned[2] + self.z)

    def after(self, inner: Transform) -> Transform:
        """Return the pose of the frame of `inner` in the outer frame of this one."""
        return Transform._make((*self.apply(*inner[:3]), *_product(self[3:], inner[3:])))

    def inverse(self) -> Transform:
        """Return the pose of the outer frame in the inner one."""
        back = Transform(0.0, 0.0, 0.0, *_conjugate(self[3:]))
        return Transform._make((*(-one for one in back.apply(*self[:3])), *back[3:]))

    def toward(self, other: Transform, share: float) -> Transform:
        """Return what lies between this one and another, at a share from 0 to 1 of the way."""
        place = [a + share * (b - a) for a, b in zip(self[:3], other[:3], strict=True)]
        cosine = sum(a * b for a, b in zip(self[3:], other[3:], strict=True))
        sign = -1.0 if cosine < 0 else 1.0
        angle = math.acos(min(abs(cosine), 1.0))
        first, second = 1 - share, share
        if abs(cosine) < _SAME:
            first, second = (math.sin(part * angle) / math.sin(angle) for part in (first, second))
        mixed = [first * a + sign * second * b for a, b in zip(self[3:], other[3:], strict=True)]
        return Transform._make((*place, *_unit(mixed)))


def unit(transform: Transform) -> Transform | None:
    """Return a transform with a rotation of length 1; None if it is not one: a value is not finite,
    or the rotation has no length.
    """
    if not all(map(math.isfinite, transform)) or math.hypot(*transform[3:]) < 1e-6:
        return None
    return Transform._make((*transform[:3], *_unit(transform[3:])))


def _unit(quaternion: tuple[float, ...] | list[float]) -> list[float]:
    length = math.hypot(*quaternion)
    return [one / length for one in quaternion]


def _conjugate(quaternion: tuple[float, ...]) -> tuple[float, ...]:
    x, y, z, w = quaternion
    return (-x, -y, -z, w)


def _product(one: tuple[float, ...], other: tuple[float, ...]) -> tuple[float, ...]:
    ax, ay, az, aw = one
    bx, by, bz, bw = other
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


class _Frame:
    """A frame: its parent, and its poses there."""

    def __init__(self, parent: str, *, is_static: bool) -> None:
        self.parent = parent
        self.is_static = is_static
        self.times: list[int] = []
        """In nanoseconds, in order."""
        self.poses: list[Transform] = []

    def add(self, time: int, pose: Transform) -> None:
        if self.is_static:
            self.times, self.poses = [time], [pose]
            return
        at = bisect_left(self.times, time)
        if at < len(self.times) and self.times[at] == time:
            self.poses[at] = pose
            return
        self.times.insert(at, time)
        self.poses.insert(at, pose)
        old = max(bisect_left(self.times, self.times[-1] - KEPT), len(self.times) - MOST_TIMES)
        del self.times[:old], self.poses[:old]

    def pose(self, time: int) -> Transform | None:
        """Return the pose at a time; None if it is not known."""
        if self.is_static:
            return self.poses[0]
        at = bisect_left(self.times, time)
        if at < len(self.times) and self.times[at] == time:
            return self.poses[at]
        if at in (0, len(self.times)):
            return None
        before, after = self.times[at - 1], self.times[at]
        share = (time - before) / (after - before)
        return self.poses[at - 1].toward(self.poses[at], share)


class TransformBuffer:
    """The poses of all frames in the last ten seconds."""

    def __init__(self) -> None:
        self._frames: dict[str, _Frame] = {}

    def add(
        self, frame: str, parent: str, time: int, pose: Transform, *, is_static: bool = False
    ) -> None:
        """Take the pose of a frame in its parent, at a time in nanoseconds. What is not a pose, and
        what lies before the kept past, is left out.
        """
        frame, parent = frame.strip("/"), parent.strip("/")
        whole = unit(pose)
        if whole is None or frame == parent or not (frame and parent):
            return
        known = self._frames.get(frame)
        if known is None or (known.parent, known.is_static) != (parent, is_static):
            if known is None and len(self._frames) == MOST_FRAMES:
                return
            known = self._frames[frame] = _Frame(parent, is_static=is_static)
        known.add(time, whole)

    def forget_moving(self) -> None:
        """Forget all but static frames, as tf2 does when the time has jumped back."""
        self._frames = {name: one for name, one in self._frames.items() if one.is_static}

    def look_up(self, frame: str, target: str, time: int | None = None) -> Transform:
        """Return the pose of a frame in another one, at a time in nanoseconds; without it, at the
        newest time that is known of all frames between them.

        Raises:
            LookupError: It is not known; the text says why.
        """
        frame, target = frame.strip("/"), target.strip("/")
        up, down = self._way(frame), self._way(target)
        shared = next((one for one in up if one in down), None)
        if shared is None:
            raise LookupError(self._missing(frame, target))
        parts = up[: up.index(shared)], down[: down.index(shared)]
        moving = [self._frames[one] for part in parts for one in part]
        newest = [one.times[-1] for one in moving if not one.is_static]
        at = min(newest, default=0) if time is None else time
        to_shared, target_to_shared = (self._composed(part, at) for part in parts)
        return target_to_shared.inverse().after(to_shared)

    def _way(self, frame: str) -> list[str]:
        """Return a frame and those above it. A circle ends where it begins again."""
        way = [frame]
        while (known := self._frames.get(way[-1])) is not None and known.parent not in way:
            way.append(known.parent)
        return way

    def _missing(self, *frames: str) -> str:
        known = {*self._frames, *(one.parent for one in self._frames.values())}
        unknown = [repr(one) for one in frames if one not in known]
        if unknown:
            return f"nothing is known of {' and '.join(unknown)}"
        return f"{frames[0]!r} and {frames[1]!r} are not connected"

    def _composed(self, frames: list[str], time: int) -> Transform:
        whole = Transform()
        for name in reversed(frames):
            frame = self._frames[name]
            pose = frame.pose(time)
            if pose is None:
                first, last = (at / 1e9 for at in (frame.times[0], frame.times[-1]))
                raise LookupError(
                    f"{name!r} is known from {first:.3f} s to {last:.3f} s,"
                    f" and not at {time / 1e9:.3f} s"
                )
            whole = whole.after(pose)
        return whole


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

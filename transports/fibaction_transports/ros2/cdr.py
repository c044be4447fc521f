"""Two ROS messages as bytes on the wire: the status list, and whose goal a feedback belongs to.

rclpy makes some four Python objects, one of them of numpy, for every line of a status list, and a
list is sent at every change of every goal: with some hundred goals that would be most of the work.
The bytes are those of CDR, in which all middlewares of ROS 2 exchange messages.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Any, TypeAlias

from fibaction.exceptions import ProtocolError
from fibaction.goals import GoalID, GoalInfo
from fibaction.states import GoalStatus

Line: TypeAlias = tuple[Any, ...]
"""A line of a status list: the goal's ID, its stamp's seconds and nanoseconds, its status."""

_BILLION = 10**9
_HEADER = b"\x00\x01\x00\x00"  # plain CDR, little-endian
# A line is a UUID, the stamp's seconds and nanoseconds, and the status. The numbers of the stamp
# are aligned to 4 bytes, so all lines but the first have a gap of 3 behind the UUID.
_GAP = slice(16, 19)


def pack_line(info: GoalInfo) -> bytes:
    """One line of a status list, as `pack_statuses` takes it."""
    seconds, nanoseconds = divmod(info.stamp, _BILLION)
    return struct.pack("<16s3xiIb", info.goal_id, seconds, nanoseconds, info.status)


def status_of(line: bytes) -> int:
    """The status in a line of `pack_line`."""
    return line[-1]


def pack_statuses(lines: Iterable[bytes]) -> bytes:
    """An `action_msgs/msg/GoalStatusArray`, from lines of `pack_line`."""
    body = bytearray(b"".join(lines))
    count = len(body) // 28
    del body[_GAP]
    return _HEADER + count.to_bytes(4, "little") + body


def unpack_statuses(message: bytes) -> list[Line]:
    """The lines of an `action_msgs/msg/GoalStatusArray`.

    Raises:
        ProtocolError: It is something else.
    """
    order = {0: ">", 1: "<"}.get(message[1]) if len(message) >= 8 else None
    try:
        if order is None:
            raise ValueError("it is no CDR")
        (count,) = struct.unpack_from(f"{order}I", message, 4)
        if count == 0:
            return []
        first = struct.unpack_from(f"{order}16siIb", message, 8)
        rest = memoryview(message)[33 : 5 + 28 * count]
        lines = [first, *struct.iter_unpack(f"{order}16s3xiIb", rest)]
        if len(lines) != count:
            raise ValueError(f"it announces {count} goals and has {len(lines)}")
    except (ValueError, struct.error) as exc:
        raise ProtocolError(f"a status list of {len(message)} bytes: {exc}") from exc
    return lines


def info_of(line: Line) -> GoalInfo:
    """What a line says.

    Raises:
        ProtocolError: There is no such status.
    """
    goal_id, seconds, nanoseconds, status = line
    try:
        known = GoalStatus(status)
    except ValueError as exc:
        raise ProtocolError(f"a status list: {exc}") from exc
    return GoalInfo(GoalID(goal_id), seconds * _BILLION + nanoseconds, known)


def goal_of_feedback(message: bytes) -> bytes:
    """The goal ID, with which every `FeedbackMessage` begins."""
    return message[4:20]

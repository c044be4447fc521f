"""The status list of an action as bytes, the lines in it, and the lines in which two lists differ;
and the number of a goal's feedback messages as bytes.

The bytes are those of CDR, the encoding that all middlewares of ROS 2 use. They are read and
written here, because rclpy makes some four Python objects, one of them of numpy, for each line of
a list, and a list is sent at every change of every goal: with some hundred goals, that would be
most of the work. For the same reason, a client reads only the lines that have changed: a server
remembers up to a thousand ended goals, and a list has all of them. The number of feedback messages
is written once for each goal, in a message of thirteen fields of which two differ.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Any, TypeAlias

from fibaction.words.errors import ProtocolError
from fibaction.words.goals import GoalID, GoalInfo
from fibaction.words.statuses import GoalStatus

StatusLine: TypeAlias = tuple[Any, ...]
"""One line of a list: the goal's ID, the seconds and nanoseconds of its stamp, its status."""

LINE_BYTES = 28
"""The bytes of a line, as `pack_line` makes it."""
MAX_PIECES = 32
"""Equal pieces of two lists that are looked for, at most: more changed goals at once are rare."""

_BILLION = 10**9
_HEADER = b"\x00\x01\x00\x00"  # plain CDR, little-endian
_START = len(_HEADER) + 4  # the number of lines follows the header
# A line is a UUID, the stamp's seconds and nanoseconds, and the status. The numbers of the stamp
# are aligned to 4 bytes, so all lines but the first have a gap of 3 after the UUID.
_ID = 16
_GAP = slice(_ID, _ID + 3)
_LINE = struct.Struct("<16s3xiIb")
# The name with its size, the type, a bool, the integer, a double, a text, five arrays.
_COUNT = struct.Struct("<4sI33sBBxqdII5I")
_NAME_BYTES = 33
_PARAMETER_INTEGER = 2
_NO_ARRAYS = (0,) * 5


def pack_line(info: GoalInfo) -> bytes:
    """Return one line of a status list, as `pack_statuses` takes it."""
    return _LINE.pack(info.goal_id, *divmod(info.stamp, _BILLION), info.status)


def status_of(line: bytes) -> int:
    """Return the status in a line of `pack_line`."""
    return line[-1]


def pack_statuses(lines: Iterable[bytes]) -> bytes:
    """Return an `action_msgs/msg/GoalStatusArray` with lines of `pack_line`."""
    body = bytearray(b"".join(lines))
    count = len(body) // LINE_BYTES
    del body[_GAP]
    return _HEADER + count.to_bytes(4, "little") + body


def lines_in(message: bytes) -> bytes:
    """Return the lines of an `action_msgs/msg/GoalStatusArray`, one after another, as `pack_line`
    makes them.

    Raises:
        ProtocolError: The message is not a status list.
    """
    order = {0: ">", 1: "<"}.get(message[1]) if len(message) >= _START else None
    if order is None:
        raise ProtocolError(f"invalid status list of {len(message)} bytes: it is not CDR")
    (count,) = struct.unpack_from(f"{order}I", message, len(_HEADER))
    if count == 0:
        return b""
    end = _START + LINE_BYTES * count - (_GAP.stop - _GAP.start)
    if len(message) < end:
        raise ProtocolError(
            f"invalid status list of {len(message)} bytes: it announces {count} goals, which need"
            f" {end}"
        )
    lines = bytearray(message[_START:end])
    lines[_ID:_ID] = bytes(_GAP.stop - _GAP.start)
    for at in range(_GAP.start, _GAP.stop):
        lines[at::LINE_BYTES] = bytes(count)  # rmw_zenoh_cpp leaves anything in gaps
    if order == "<":
        return bytes(lines)
    return b"".join(_LINE.pack(*line) for line in struct.iter_unpack(f">{_LINE.format[1:]}", lines))


def unpack_lines(lines: bytes) -> list[StatusLine]:
    """Return the lines of `lines_in`, each as a tuple."""
    return list(_LINE.iter_unpack(lines))


def differences(before: bytes, now: bytes) -> tuple[list[StatusLine], list[StatusLine]]:
    """Return the lines that only the first of two lists has, and those that only the second has,
    both in order. The lists are those of `lines_in`.

    Most lines are the same, and in the same order, so long pieces are compared as bytes. What is
    left after `MAX_PIECES` of them is compared line by line.
    """
    gone, new = bytearray(), bytearray()
    old, at = 0, 0
    for _ in range(MAX_PIECES):
        same = _equal_bytes(before[old:], now[at:])
        old, at = old + same, at + same
        line = now[at : at + LINE_BYTES]
        if not line:
            break
        found = before.find(line, old)
        if found >= 0 and found % LINE_BYTES == 0:
            gone += before[old:found]
            old = found
        else:
            new += line
            at += LINE_BYTES
            if before[old : old + _ID] == line[:_ID]:  # the same goal
                gone += before[old : old + LINE_BYTES]
                old += LINE_BYTES
    gone_lines = unpack_lines(bytes(gone) + before[old:])
    new_lines = unpack_lines(bytes(new) + now[at:])
    known, kept = set(gone_lines), set(new_lines)
    return (
        [line for line in gone_lines if line not in kept],
        [line for line in new_lines if line not in known],
    )


def _equal_bytes(one: bytes, other: bytes) -> int:
    """Return the length of the lines at the beginning that are the same."""
    least, most = 0, min(len(one), len(other)) // LINE_BYTES
    while least < most:
        middle = (least + most + 1) // 2
        part = slice(LINE_BYTES * least, LINE_BYTES * middle)
        if one[part] == other[part]:
            least = middle
        else:
            most = middle - 1
    return LINE_BYTES * least


def stamps_of(message: bytes) -> dict[bytes, int]:
    """Return the stamps of the goals in an `action_msgs/msg/GoalStatusArray`, by their IDs.

    Raises:
        ProtocolError: The message is not a status list.
    """
    return {line[0]: line[1] * _BILLION + line[2] for line in unpack_lines(lines_in(message))}


def info_of(line: StatusLine) -> GoalInfo:
    """Return the goal of a line.

    Raises:
        ProtocolError: The number is not a status of ROS.
    """
    goal_id, seconds, nanoseconds, status = line
    try:
        known = GoalStatus(status)
    except ValueError as exc:
        raise ProtocolError(f"invalid status list: {exc}") from exc
    return GoalInfo(GoalID(goal_id), seconds * _BILLION + nanoseconds, known)


def pack_count(goal_id: GoalID, count: int) -> bytes:
    """Return an `rcl_interfaces/msg/Parameter` with the name of a goal, and an integer."""
    name = str(goal_id).encode()
    number = _PARAMETER_INTEGER, 0, count, 0.0
    return _COUNT.pack(_HEADER, _NAME_BYTES, name, *number, 1, 0, *_NO_ARRAYS)


def goal_of_feedback(message: bytes) -> bytes:
    """Return the goal ID, the first field of every `FeedbackMessage`."""
    return message[4:20]

"""The status list as bytes: packed, read, and compared with the list before."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fibaction import GoalID, GoalInfo, GoalStatus
from fibaction.words.errors import ProtocolError
from fibaction_transports.ros2.convert.status_bytes import (
    MAX_PIECES,
    StatusLine,
    differences,
    goal_of_feedback,
    info_of,
    lines_in,
    pack_line,
    pack_statuses,
    stamps_of,
    unpack_lines,
)

messages: Any = import_module("action_msgs.msg")
serialization: Any = import_module("rclpy.serialization")

ids = st.binary(min_size=16, max_size=16).map(GoalID)
infos = st.builds(GoalInfo, ids, st.integers(0, 2**31 * 10**9 - 1), st.sampled_from(GoalStatus))
lists = st.lists(infos, max_size=20, unique_by=lambda info: info.goal_id)

ONE, TWO = GoalID(b"1" * 16), GoalID(b"2" * 16)


def message_of(goals: list[GoalInfo]) -> Any:
    """Return the same list as a message of rclpy."""
    message = messages.GoalStatusArray()
    for info in goals:
        line = messages.GoalStatus(status=int(info.status))
        line.goal_info.goal_id.uuid[:] = list(info.goal_id)
        line.goal_info.stamp.sec, line.goal_info.stamp.nanosec = divmod(info.stamp, 10**9)
        message.status_list.append(line)
    return message


def packed(*goals: GoalInfo) -> bytes:
    return pack_statuses(map(pack_line, goals))


def unpack(message: bytes) -> list[StatusLine]:
    return unpack_lines(lines_in(message))


@given(lists)
def test_ros_reads_the_lists_that_are_packed_here(goals: list[GoalInfo]) -> None:
    read = serialization.deserialize_message(packed(*goals), messages.GoalStatusArray)
    assert read == message_of(goals)


@given(lists)
def test_the_lists_that_ros_has_packed_are_read_here(goals: list[GoalInfo]) -> None:
    lines = unpack(serialization.serialize_message(message_of(goals)))
    assert [info_of(line) for line in lines] == goals


def test_big_endian_lists_are_read_too() -> None:
    message = bytes.fromhex("00000000 00000001") + ONE + bytes.fromhex("00000001 00000002 04")
    (line,) = unpack(message)
    assert info_of(line) == GoalInfo(ONE, 1_000_000_002, GoalStatus.SUCCEEDED)


def test_gaps_with_anything_in_them_are_no_difference() -> None:
    """As `rmw_zenoh_cpp` leaves them: else each list differs from the one before in each line."""
    goals = [GoalInfo(GoalID.random(), 5, GoalStatus.SUCCEEDED) for _ in range(3)]
    message = bytearray(packed(*goals))
    for line in (1, 2):  # the first one has no gap
        at = 8 + 28 * line + 16 - 3
        assert message[at : at + 3] == bytes(3)
        message[at : at + 3] = b"\x04?\x7f"
    assert lines_in(bytes(message)) == lines_in(packed(*goals))


@given(st.binary(max_size=200))
def test_any_bytes_are_a_list_or_a_protocol_error(message: bytes) -> None:
    try:
        for line in unpack(message):
            info_of(line)
    except ProtocolError:
        pass


def test_a_list_that_ends_too_early_is_a_protocol_error() -> None:
    whole = packed(GoalInfo(ONE, 1, GoalStatus.ACCEPTED), GoalInfo(TWO, 2, GoalStatus.ACCEPTED))
    for length in range(len(whole)):
        with pytest.raises(ProtocolError, match=f"invalid status list of {length} bytes"):
            unpack(whole[:length])


def test_a_feedback_message_begins_with_its_goals_id() -> None:
    interfaces: Any = import_module("arduinobot_msgs.action")
    message = interfaces.Fibonacci.Impl.FeedbackMessage()
    message.goal_id.uuid[:] = list(ONE)
    assert goal_of_feedback(serialization.serialize_message(message)) == ONE


def test_an_invalid_status_is_a_protocol_error() -> None:
    with pytest.raises(ProtocolError, match="invalid status list: 77"):
        info_of((bytes(16), 0, 0, 77))


def test_the_stamps_of_a_list_are_those_of_its_goals() -> None:
    first, second = GoalInfo(ONE, 5, GoalStatus.ACCEPTED), GoalInfo(TWO, 10**9, GoalStatus.ABORTED)
    assert stamps_of(packed(first, second)) == {ONE: 5, TWO: 10**9}


# Differences

few = st.sampled_from([GoalID(bytes([number]) * 16) for number in range(1, 9)])
few_infos = st.builds(GoalInfo, few, st.integers(0, 1), st.sampled_from(GoalStatus))


def lines_of(goals: list[GoalInfo]) -> bytes:
    return b"".join(map(pack_line, goals))


def compared(before: list[GoalInfo], now: list[GoalInfo]) -> list[list[GoalInfo]]:
    """Return the differences that a look at each line finds."""
    return [
        [one for one in before if one not in now],
        [one for one in now if one not in before],
    ]


@given(
    st.lists(few_infos, unique_by=lambda info: info.goal_id),
    st.lists(few_infos, unique_by=lambda info: info.goal_id),
)
def test_the_differences_of_two_lists_are_those_of_their_lines(
    before: list[GoalInfo], now: list[GoalInfo]
) -> None:
    found = differences(lines_of(before), lines_of(now))
    assert [[info_of(line) for line in part] for part in found] == compared(before, now)


@pytest.mark.parametrize("changed", [1, MAX_PIECES - 1, MAX_PIECES, 3 * MAX_PIECES])
def test_few_and_many_changes_in_a_long_list_are_found(changed: int) -> None:
    goals = [
        GoalInfo(GoalID(number.to_bytes(16, "big")), number, GoalStatus.EXECUTING)
        for number in range(1, 1001)
    ]
    step = len(goals) // changed
    ended = [
        GoalInfo(info.goal_id, info.stamp, GoalStatus.SUCCEEDED) if index % step == 0 else info
        for index, info in enumerate(goals)
    ]
    now = [*ended[3:500], *ended[501:], GoalInfo(ONE, 1, GoalStatus.ACCEPTED)]
    found = differences(lines_of(goals), lines_of(now))
    assert [[info_of(line) for line in part] for part in found] == compared(goals, now)


def test_a_line_that_is_found_within_two_others_is_new() -> None:
    within = lines_of([GoalInfo(ONE, 1, GoalStatus.ACCEPTED), GoalInfo(TWO, 2, GoalStatus.ABORTED)])
    line = within[20:48]
    assert differences(within, line) == (unpack_lines(within), unpack_lines(line))

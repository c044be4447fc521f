"""Arguments for ROS 2 among those of a command; tests/ros2 shows that ROS gets them."""

from __future__ import annotations

import pytest

from fibaction.cli.app import without_ros_args
from tests.cli.conftest import Run


@pytest.mark.parametrize(
    ("line", "own"),
    [
        ("serve a:b", "serve a:b"),
        ("serve a:b --ros-args -r __ns:=/x -p use_sim_time:=true", "serve a:b"),
        ("--ros-args -r a:=b -- serve a:b", "serve a:b"),
        ("serve --ros-args -- a:b --ros-args --log-level info", "serve a:b"),
        ("serve -- a:b", "serve -- a:b"),
        ("--ros-args", ""),
    ],
)
def test_what_is_for_ros_goes_up_to_two_dashes(line: str, own: str) -> None:
    assert without_ros_args(line.split()) == own.split()


def test_a_command_does_without_what_is_for_ros(fibaction: Run, tcp: str) -> None:
    done = fibaction("list", "--ros-args", "-r", "__ns:=/robot1", url=tcp)

    assert (done.code, done.err) == (0, "")
    assert "/fibonacci" in done.lines

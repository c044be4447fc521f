"""The part of a command line that is for ROS 2, as `ros2 run` and `ros2 launch` add it.

It goes from `--ros-args` to `--` or to the end, may come several times, and is read by rclpy from
the command line of the process: https://design.ros2.org/articles/ros_command_line_arguments.html
"""

from __future__ import annotations

from collections.abc import Iterable


def without_ros_args(arguments: Iterable[str]) -> list[str]:
    """Return the arguments that are not for ROS 2."""
    own: list[str] = []
    is_for_ros = False
    for argument in arguments:
        if argument == "--ros-args":
            is_for_ros = True
        elif not is_for_ros:
            own.append(argument)
        elif argument == "--":
            is_for_ros = False
    return own

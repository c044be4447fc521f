"""`ros2 launch fibaction_fibonacci two_robots.launch.py`: one server for each of two robots."""

from __future__ import annotations

from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Return a node in the namespace of each robot."""
    return LaunchDescription(
        [
            Node(
                package="fibaction_fibonacci",
                executable="fibonacci_node",
                namespace=robot,
                output="screen",
            )
            for robot in ("robot1", "robot2")
        ]
    )

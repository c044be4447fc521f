"""Nav2 as its clients see it: action servers of rclpy, and a robot that drives in straight lines.

A new goal preempts the one before it, which is aborted, as at the servers of Nav2.
"""

from __future__ import annotations

import math
from threading import Lock
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav2_msgs.action import FollowWaypoints, NavigateThroughPoses, NavigateToPose

from tests.ros2.stock.serving import serve, wait

STEP = 0.05
"""The metres that the robot drives between two messages of feedback."""


class Robot:
    """Drives to poses, for the newest goal only."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._newest: Any = None
        self._x = self._y = 0.0

    def to_pose(self, handle: Any) -> Any:
        return self._run(handle, [handle.request.pose], NavigateToPose)

    def through_poses(self, handle: Any) -> Any:
        return self._run(handle, handle.request.poses, NavigateThroughPoses)

    def waypoints(self, handle: Any) -> Any:
        return self._run(handle, handle.request.poses, FollowWaypoints)

    def _run(self, handle: Any, poses: list[PoseStamped], kind: Any) -> Any:
        self._newest = handle
        with self._lock:  # it is free when the goal before has seen that it is not the newest
            for number, pose in enumerate(poses):
                while (left := self._drive(pose)) > 0:
                    handle.publish_feedback(self._feedback(kind, left, number, len(poses)))
                    wait()
                    if handle.is_cancel_requested:
                        handle.canceled()
                        return kind.Result()
                    if self._newest is not handle:
                        handle.abort()
                        return kind.Result()
            handle.succeed()
            return kind.Result()

    def _drive(self, pose: PoseStamped) -> float:
        """Drive one step, and return the metres that are left."""
        x, y = pose.pose.position.x - self._x, pose.pose.position.y - self._y
        left = math.hypot(x, y)
        part = min(1.0, STEP / left) if left else 0.0
        self._x, self._y = self._x + x * part, self._y + y * part
        return left * (1 - part)

    def _feedback(self, kind: Any, left: float, number: int, count: int) -> Any:
        if kind is FollowWaypoints:
            return FollowWaypoints.Feedback(current_waypoint=number)
        feedback = kind.Feedback(distance_remaining=left)
        feedback.current_pose.pose.position.x = self._x
        feedback.current_pose.pose.position.y = self._y
        if kind is NavigateThroughPoses:
            feedback.number_of_poses_remaining = count - number
        return feedback


if __name__ == "__main__":
    robot = Robot()
    serve(
        "bt_navigator",
        (NavigateToPose, "navigate_to_pose", robot.to_pose),
        (NavigateThroughPoses, "navigate_through_poses", robot.through_poses),
        (FollowWaypoints, "follow_waypoints", robot.waypoints),
    )

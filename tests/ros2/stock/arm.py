"""An arm as clients of ros2_control and of MoveIt see it: action servers of rclpy.

The controller follows trajectories of the joints `JOINTS`; `move_group` plans to the joint
constraints of a goal, and executes the plan unless it is asked for the plan only.
"""

from __future__ import annotations

import time
from typing import Any

from control_msgs.action import FollowJointTrajectory
from moveit_msgs.action import ExecuteTrajectory, MoveGroup
from moveit_msgs.msg import MoveItErrorCodes, RobotTrajectory
from trajectory_msgs.msg import JointTrajectoryPoint

from tests.ros2.stock.serving import serve, wait

JOINTS = ["shoulder", "elbow"]
GROUP = "arm"


def seconds(point: Any) -> float:
    return float(point.time_from_start.sec + point.time_from_start.nanosec / 1e9)


def follow(handle: Any) -> Any:
    result = FollowJointTrajectory.Result()
    wanted = handle.request.trajectory
    if list(wanted.joint_names) != JOINTS:
        handle.abort()
        result.error_code = FollowJointTrajectory.Result.INVALID_JOINTS
        result.error_string = "the joints are shoulder and elbow"
        return result
    start = time.monotonic()
    for point in wanted.points:
        while time.monotonic() - start < seconds(point):
            feedback = FollowJointTrajectory.Feedback(joint_names=JOINTS, desired=point)
            feedback.error.positions = [point.positions[0] / 100, 0.0]
            handle.publish_feedback(feedback)
            wait()
            if handle.is_cancel_requested:
                handle.canceled()
                return result
    handle.succeed()
    return result


def move(handle: Any) -> Any:
    result = MoveGroup.Result()
    request = handle.request.request
    if request.group_name != GROUP:
        handle.abort()
        result.error_code.val = MoveItErrorCodes.INVALID_GROUP_NAME
        return result
    plan = result.planned_trajectory.joint_trajectory
    constraints = request.goal_constraints[0].joint_constraints
    plan.joint_names = [one.joint_name for one in constraints]
    plan.points = [JointTrajectoryPoint(positions=[one.position for one in constraints])]
    states = ["PLANNING"] if handle.request.planning_options.plan_only else ["PLANNING", "MONITOR"]
    for state in [*states, "IDLE"]:
        for _ in range(10):
            handle.publish_feedback(MoveGroup.Feedback(state=state))
            wait()
    result.error_code.val = MoveItErrorCodes.SUCCESS
    handle.succeed()
    return result


def execute(handle: Any) -> Any:
    trajectory: RobotTrajectory = handle.request.trajectory
    while not handle.is_cancel_requested:
        handle.publish_feedback(ExecuteTrajectory.Feedback(state="MONITOR"))
        wait()
        if trajectory.joint_trajectory.points[0].positions[0] < 1:  # a long way ends by a cancel
            handle.succeed()
            code = MoveItErrorCodes(val=MoveItErrorCodes.SUCCESS)
            return ExecuteTrajectory.Result(error_code=code)
    handle.canceled()
    code = MoveItErrorCodes(val=MoveItErrorCodes.PREEMPTED)
    return ExecuteTrajectory.Result(error_code=code)


if __name__ == "__main__":
    serve(
        "arm",
        (FollowJointTrajectory, "arm_controller/follow_joint_trajectory", follow),
        (MoveGroup, "move_action", move),
        (ExecuteTrajectory, "execute_trajectory", execute),
    )

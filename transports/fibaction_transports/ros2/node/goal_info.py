"""The `action_msgs/msg/GoalInfo` of a goal."""

from __future__ import annotations

from typing import Any

from fibaction.words.goals import GoalInfo
from fibaction_transports.ros2.node.ros_node import RosTypes


def goal_info_to_ros(types: RosTypes, info: GoalInfo) -> Any:
    """Return the `action_msgs/msg/GoalInfo` of a goal. It has no field for the status."""
    message = types.GoalInfo()
    message.goal_id.uuid = types.uuid(info.goal_id)
    message.stamp.sec, message.stamp.nanosec = divmod(info.stamp, 10**9)
    return message

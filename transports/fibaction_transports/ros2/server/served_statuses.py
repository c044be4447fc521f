"""`ServedStatuses`: the status topic of a served action, with the stamps of its goals in ROS."""

from __future__ import annotations

import math
from typing import Any

from anyio import current_time
from anyio.abc import TaskGroup

from fibaction.words.goals import GoalID, GoalInfo
from fibaction.words.statuses import GoalStatus
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.convert.status_bytes import pack_statuses
from fibaction_transports.ros2.node.ros_node import RosNode
from fibaction_transports.ros2.node.stamps import ServedStamps
from fibaction_transports.ros2.node.status_list import PublishedStatuses
from fibaction_transports.ros2.settings import RosSettings


class ServedStatuses:
    """The goals of one action in the status list that its server publishes."""

    def __init__(self, ros: RosNode, topic: str, message_type: Any, settings: RosSettings) -> None:
        """Make the publisher, and publish nothing yet."""
        profile = qos.published_status(settings.lease, settings.status_qos)
        self._publisher = ros.publisher(topic, message_type, profile)
        self._list = PublishedStatuses(self._publish)
        self.stamps = ServedStamps(ros.clock)
        """The stamps of the goals in ROS."""
        self.published_at = -math.inf
        """The time at which a list was published last."""
        self.flush = self._list.flush
        self.repeat_later = self._list.repeat_later

    def start(self, tasks: TaskGroup, action: str) -> None:
        """Publish the list without goals, so that clients need not wait for a list, and then each
        change.
        """
        self._publish(pack_statuses(()))
        tasks.start_soon(self._list.run, name=f"statuses of {action}")
        tasks.start_soon(self._list.repeat, name=f"repeated statuses of {action}")

    def __contains__(self, goal_id: GoalID) -> bool:
        return goal_id in self._list

    def update(self, info: GoalInfo) -> None:
        """Set the status of a goal. UNKNOWN removes it; an earlier or equal status is ignored."""
        if info.status is GoalStatus.UNKNOWN:
            self.stamps.forget(info.goal_id)
            self._list.update(info)
        else:
            self._list.update(self.in_ros(info))

    def in_ros(self, info: GoalInfo) -> GoalInfo:
        """Return the status of a goal with its stamp in ROS."""
        return GoalInfo(info.goal_id, self.stamps.to_ros(info.goal_id, info.stamp), info.status)

    def clear(self) -> None:
        """Remove all goals: the endpoint was restarted, or cannot be reached."""
        self._list.clear()
        self.stamps.clear()

    def _publish(self, message: bytes) -> None:
        self.published_at = current_time()
        self._publisher.publish_bytes(message)

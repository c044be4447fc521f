"""Actions of ROS 2: servers for any client of ROS, and clients of any server of ROS."""

from fibaction_transports.ros2.dds_transport import DdsTransport
from fibaction_transports.ros2.ros2_transport import Ros2Transport

__all__ = ["DdsTransport", "Ros2Transport"]

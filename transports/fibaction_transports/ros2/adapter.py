"""`RosAdapter`: the way to a graph of ROS, through one middleware."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import AbstractAsyncContextManager

from fibaction_transports.ros2.node.ros_node import RosNode, RosTypes


class RosAdapter(ABC):
    """The way to a graph of ROS."""

    types: RosTypes

    @abstractmethod
    def open(self) -> AbstractAsyncContextManager[RosNode]:
        """Open a node for as long as the block lasts.

        Raises:
            TransportError: ROS does not allow such a node, or it cannot be made.
        """

"""Actions of ROS 2: servers for any client of ROS, and clients of any server of ROS."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fibaction_transports.ros2.dds_transport import DdsTransport
    from fibaction_transports.ros2.messaging.node import Node, open_node, topic_values
    from fibaction_transports.ros2.messaging.parameters import OwnParameters, RemoteParameters
    from fibaction_transports.ros2.messaging.services import Service
    from fibaction_transports.ros2.messaging.topics import Publisher, Subscription
    from fibaction_transports.ros2.messaging.transforms import Transform
    from fibaction_transports.ros2.qos import EndQos
    from fibaction_transports.ros2.ros2_transport import Ros2Transport
    from fibaction_transports.ros2.zenoh_transport import ZenohTransport

__all__ = [
    "DdsTransport",
    "EndQos",
    "Node",
    "OwnParameters",
    "Publisher",
    "RemoteParameters",
    "Ros2Transport",
    "Service",
    "Subscription",
    "Transform",
    "ZenohTransport",
    "open_node",
    "topic_values",
]

_MODULES = {
    "DdsTransport": "dds_transport",
    "EndQos": "qos",
    "Node": "messaging.node",
    "OwnParameters": "messaging.parameters",
    "Publisher": "messaging.topics",
    "RemoteParameters": "messaging.parameters",
    "Service": "messaging.services",
    "Subscription": "messaging.topics",
    "Transform": "messaging.transforms",
    "open_node": "messaging.node",
    "topic_values": "messaging.node",
    "Ros2Transport": "ros2_transport",
    "ZenohTransport": "zenoh_transport",
}


def __getattr__(name: str) -> Any:
    # ROS messages in actions of other transports need `convert` alone, which takes no nodes.
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)

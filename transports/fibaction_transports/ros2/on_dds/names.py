"""The names that ROS gives to topics and types in DDS.

https://design.ros2.org/articles/topic_and_service_names.html has those of topics and services.
"""

from __future__ import annotations

from typing import Final

GRAPH_TOPIC: Final = "ros_discovery_info"
"""The topic on which each participant tells which of its endpoints belong to which node."""
_TOPIC: Final = "rt"
_REQUEST, _REPLY = ("rq", "Request"), ("rr", "Reply")


def topic_name(full: str) -> str:
    """Return the name in DDS of a topic of ROS, which is given by its full name."""
    return _TOPIC + full


def request_topic(service: str) -> str:
    """Return the name in DDS of the topic with the requests to a service."""
    return service.join(_REQUEST)


def reply_topic(service: str) -> str:
    """Return the name in DDS of the topic with the replies of a service."""
    return service.join(_REPLY)


def ros_topic(name: str) -> str:
    """Return the full name in ROS of a topic of DDS; empty if it is not a topic of ROS."""
    return name.removeprefix(_TOPIC) if name.startswith(f"{_TOPIC}/") else ""


def dds_type(type_name: str) -> str:
    """Return the name in DDS of a type of ROS: `std_msgs::msg::dds_::String_` for
    `std_msgs/msg/String`.
    """
    package, folder, name = type_name.split("/")
    return f"{package}::{folder}::dds_::{name}_"


def ros_type(name: str) -> str:
    """Return the name in ROS of a type of DDS; the name itself if ROS has not made it."""
    package, *rest = name.split("::")
    if len(rest) == 3 and rest[1] == "dds_" and rest[2].endswith("_"):
        return "/".join((package, rest[0], rest[2][:-1]))
    return name

"""The names that ROS gives to topics and services in DDS.

https://design.ros2.org/articles/topic_and_service_names.html has them.
"""

from __future__ import annotations

from typing import Final

GRAPH_TOPIC: Final = "ros_discovery_info"
"""The topic on which each participant tells which of its endpoints belong to which node."""
_TOPIC: Final = "rt"
_REQUESTS, _REPLIES = ("rq", "Request"), ("rr", "Reply")


def topic_name(full: str) -> str:
    """Return the name in DDS of a topic of ROS, which is given by its full name."""
    return _TOPIC + full


def request_topic(service: str) -> str:
    """Return the name in DDS of the topic with the requests to a service."""
    return service.join(_REQUESTS)


def reply_topic(service: str) -> str:
    """Return the name in DDS of the topic with the replies of a service."""
    return service.join(_REPLIES)


def ros_topic(name: str) -> str:
    """Return the full name in ROS of a topic of DDS; empty if it is not a topic of ROS."""
    return name.removeprefix(_TOPIC) if name.startswith(f"{_TOPIC}/") else ""


def ros_service(name: str) -> str:
    """Return the full name in ROS of a service by its topic of requests; empty if it is none."""
    first, last = _REQUESTS
    is_service = name.startswith(f"{first}/") and name.endswith(last)
    return name.removeprefix(first).removesuffix(last) if is_service else ""

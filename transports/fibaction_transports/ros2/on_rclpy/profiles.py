"""Quality of service as rclpy has it: the profiles of ends, and what the graph tells of others."""

from __future__ import annotations

import math
from typing import Any

from fibaction_transports.ros2.node.parts import EndInfo
from fibaction_transports.ros2.on_rclpy.rcl import Duration, rclpy_qos
from fibaction_transports.ros2.qos import EndQos

_BILLION = 10**9
_INFINITE = 2**63 - 1
"""The nanoseconds of an infinite duration."""
_UNNAMED = "_NODE_NAME_UNKNOWN_"


def profile_of(qos: EndQos) -> Any:
    """Return the profile for an end."""
    profile = rclpy_qos.QoSProfile(
        reliability=rclpy_qos.ReliabilityPolicy[qos.reliability.upper()],
        durability=rclpy_qos.DurabilityPolicy[qos.durability.upper()],
        depth=qos.depth,
    )
    if not math.isinf(qos.lease):
        profile.liveliness = rclpy_qos.LivelinessPolicy.AUTOMATIC
        profile.liveliness_lease_duration = Duration(seconds=qos.lease)
    return profile


def end_info(end: Any) -> EndInfo:
    """Return what the graph tells of an end."""
    profile = end.qos_profile
    lease = profile.liveliness_lease_duration.nanoseconds
    return EndInfo(
        bytes(end.endpoint_gid),
        _full_name(end.node_namespace, end.node_name),
        EndQos(
            reliability=profile.reliability.name.lower(),
            durability=profile.durability.name.lower(),
            depth=profile.depth,
            lease=lease / _BILLION if lease < _INFINITE else math.inf,
        ),
    )


def _full_name(namespace: str, name: str) -> str:
    """Return the full name of a node; empty if it is not yet discovered."""
    return "" if name == _UNNAMED else f"{namespace.rstrip('/')}/{name}"

"""Quality of service of an action's parts: that of rcl_action (`rcl_action/default_qos.h`).

The depths are larger than those of rcl_action. They need not match at the two ends: a depth is
only the length of the queue of one reader or writer.
"""

from __future__ import annotations

from typing import Any

from fibaction_transports.ros2.rcl import Duration, rclpy_qos

REQUEST_DEPTH = 1000
"""Requests, or answers, that may wait to be taken. rcl_action's 10 overflow when 11 arrive at once,
and a lost request is noticed only by its missing answer."""
STATUS_DEPTH = 100
"""Status lists that may wait to be taken. rcl_action's 1 hides all but the last."""
LEASE = 2.0
"""Seconds without a sign of life after which a server of fibaction counts as dead."""


def services() -> Any:
    """Return the quality of service of the three services."""
    return rclpy_qos.QoSProfile(depth=REQUEST_DEPTH).get_c_qos_profile()


def feedback(depth: int) -> Any:
    """Return the quality of service of the feedback topic."""
    return rclpy_qos.QoSProfile(depth=depth).get_c_qos_profile()


def published_status() -> Any:
    """Return that of the status topic's publisher. Its finite lease suits every subscriber."""
    return rclpy_qos.QoSProfile(
        depth=1,
        durability=rclpy_qos.DurabilityPolicy.TRANSIENT_LOCAL,
        liveliness=rclpy_qos.LivelinessPolicy.AUTOMATIC,
        liveliness_lease_duration=Duration(seconds=LEASE),
    ).get_c_qos_profile()


def subscribed_status() -> Any:
    """Return that of the subscription to the status topic."""
    return rclpy_qos.QoSProfile(
        depth=STATUS_DEPTH, durability=rclpy_qos.DurabilityPolicy.TRANSIENT_LOCAL
    ).get_c_qos_profile()


def liveliness() -> Any:
    """Return that of a second subscription to the status topic, which matches only servers with a
    lease.
    """
    return rclpy_qos.QoSProfile(
        depth=1,
        reliability=rclpy_qos.ReliabilityPolicy.BEST_EFFORT,
        liveliness=rclpy_qos.LivelinessPolicy.AUTOMATIC,
        liveliness_lease_duration=Duration(seconds=LEASE),
    ).get_c_qos_profile()

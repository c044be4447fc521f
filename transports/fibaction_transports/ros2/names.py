"""The names and the quality of service of an action's parts: those of rcl_action.

`rcl_action/names.c` and `rcl_action/default_qos.h`. Depths are no part of what must match, so they
are larger here: they only say how much a reader or a writer of ours remembers.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from fibaction.exceptions import TransportError
from fibaction_transports.ros2.rcl import Duration, qos

REQUESTS = 1000
"""How many requests, or answers, may wait to be taken: rcl_action's 10 overflow when 11 come at
once, and one that is lost is noticed only by its absence."""
STATUSES = 100
"""How many status lists may wait to be taken: rcl_action's 1 hides all but the last."""
LEASE = 2.0
"""Seconds without a sign of life after which a server of fibaction counts as dead."""


class ActionNames(NamedTuple):
    """The full names of an action's services and topics."""

    send_goal: str
    cancel_goal: str
    get_result: str
    feedback: str
    status: str


def action_names(node: Any, action: str) -> ActionNames:
    """Expand and remap an action's name as the node does with names of topics.

    Raises:
        TransportError: It is no name.
    """
    try:
        full = node.resolve_topic_name(action)
    except Exception as exc:  # rclpy raises whatever rcl says
        raise TransportError(f"{action!r} is no name in ROS: {exc}") from exc
    return ActionNames(*(f"{full}/_action/{part}" for part in ActionNames._fields))


def services() -> Any:
    """For the three services."""
    return qos.QoSProfile(depth=REQUESTS).get_c_qos_profile()


def feedback(depth: int) -> Any:
    """For the feedback topic."""
    return qos.QoSProfile(depth=depth).get_c_qos_profile()


def published_status() -> Any:
    """For the status topic's publisher; the lease is finite, which suits every subscriber."""
    return qos.QoSProfile(
        depth=1,
        durability=qos.DurabilityPolicy.TRANSIENT_LOCAL,
        liveliness=qos.LivelinessPolicy.AUTOMATIC,
        liveliness_lease_duration=Duration(seconds=LEASE),
    ).get_c_qos_profile()


def subscribed_status() -> Any:
    """For the status topic's subscription."""
    return qos.QoSProfile(
        depth=STATUSES, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL
    ).get_c_qos_profile()


def liveliness() -> Any:
    """For a second subscription to the status topic, which matches servers with a lease only."""
    return qos.QoSProfile(
        depth=1,
        reliability=qos.ReliabilityPolicy.BEST_EFFORT,
        liveliness=qos.LivelinessPolicy.AUTOMATIC,
        liveliness_lease_duration=Duration(seconds=LEASE),
    ).get_c_qos_profile()

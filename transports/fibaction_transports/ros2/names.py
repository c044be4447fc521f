"""Full names of an action's services and topics: those of rcl_action (`rcl_action/names.c`)."""

from __future__ import annotations

from typing import Any, NamedTuple

from fibaction.exceptions import TransportError


class ActionNames(NamedTuple):
    """The full names of an action's services and topics."""

    send_goal: str
    cancel_goal: str
    get_result: str
    feedback: str
    status: str


def action_names(node: Any, action: str) -> ActionNames:
    """Expand and remap the name of an action, as the node does with the names of topics.

    Raises:
        TransportError: ROS does not allow this name.
    """
    try:
        full = node.resolve_topic_name(action)
    except Exception as exc:  # rclpy raises whatever rcl says
        raise TransportError(f"{action!r} is not a valid name in ROS: {exc}") from exc
    return ActionNames(*(f"{full}/_action/{part}" for part in ActionNames._fields))

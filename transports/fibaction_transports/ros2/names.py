"""Full names of an action's services and topics: those of rcl_action (`rcl_action/names.c`), and
one of fibaction.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from fibaction.words.errors import TransportError


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
    full = _resolved(node, action)
    return ActionNames(*(f"{full}/_action/{part}" for part in ActionNames._fields))


def count_topic(node: Any, action: str) -> str:
    """Return the full name of the topic on which a server of fibaction tells the numbers of
    feedback messages. It does not contain `/_action/feedback`, by which the tools of ROS find an
    action.

    Raises:
        TransportError: ROS does not allow this name.
    """
    return f"{_resolved(node, action)}/_action/_fibaction_count"


def _resolved(node: Any, action: str) -> str:
    try:
        full: str = node.resolve_topic_name(action)
    except Exception as exc:  # rclpy raises whatever rcl says
        raise TransportError(f"{action!r} is not a valid name in ROS: {exc}") from exc
    return full

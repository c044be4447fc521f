"""Full names of an action's services and topics: those of rcl_action (`rcl_action/names.c`), and
one of fibaction.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple


class ActionNames(NamedTuple):
    """The full names of an action's services and topics."""

    send_goal: str
    cancel_goal: str
    get_result: str
    feedback: str
    status: str


def action_names(resolve: Callable[[str], str], action: str) -> ActionNames:
    """Expand and remap the name of an action by `RosNode.resolve`, as the names of topics are.

    Raises:
        TransportError: ROS does not allow this name.
    """
    full = resolve(action)
    return ActionNames(*(f"{full}/_action/{part}" for part in ActionNames._fields))


def count_topic(resolve: Callable[[str], str], action: str) -> str:
    """Return the full name of the topic on which a server of fibaction tells the numbers of
    feedback messages. It does not contain `/_action/feedback`, by which the tools of ROS find an
    action.

    Raises:
        TransportError: ROS does not allow this name.
    """
    return f"{resolve(action)}/_action/_fibaction_count"

"""Items that an executor yields and that are of neither type: ROS messages, and mistakes."""

from __future__ import annotations

from typing import Any

from fibaction.types.action import Action
from fibaction.types.ros_classes import is_message, ros_type_of


class Misuse(Exception):
    """A rule of executors that the user's generator broke."""


def is_feedback_message(item: object, action: Action[Any, Any, Any]) -> bool:
    """Return whether an item that is of neither type is a ROS message for feedback, not a result.

    Raises:
        Misuse: It is for neither, or could be for both.
    """
    feedback, result = action.feedback.accepts(item), action.result.accepts(item)
    if feedback and result:
        raise Misuse(f"it yielded {a(item)}, which could be feedback or a result")
    if not feedback and not result:
        raise Misuse(f"it yielded {a(item)}, which is neither feedback nor a result")
    return feedback


def a(value: object) -> str:
    """Return the type of a value with its article."""
    if is_message(value):
        return f"the ROS message {ros_type_of(type(value))}"
    name = type(value).__qualname__
    return f"an {name}" if name[0] in "AEIOUaeiou" else f"a {name}"

"""Items that an executor yields and that are of neither type: ROS messages, and mistakes."""

from __future__ import annotations

from typing import Any

from fibaction.server.execution.executor_ends import Misuse, kind_of
from fibaction.types.action import Action


def is_feedback_message(item: object, action: Action[Any, Any, Any]) -> bool:
    """Return whether an item that is of neither type is a ROS message for feedback, not a result.

    Raises:
        Misuse: It is for neither, or could be for both.
    """
    feedback, result = action.feedback.accepts(item), action.result.accepts(item)
    if feedback and result:
        raise Misuse(
            f"it yielded {kind_of(item)}, which could be feedback or a result:"
            " mark the result with `Return(...)`"
        )
    if not feedback and not result:
        raise Misuse(f"it yielded {kind_of(item)}, which is neither feedback nor a result")
    return feedback

"""The messages that ROS makes of the three messages of an action, and their codecs.

They are the requests and responses of its services `SendGoal` and `GetResult`, and the
`FeedbackMessage`. The fields of their structs are those of ROS.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from msgspec import Struct

from fibaction.interfaces.files import ActionFile, InterfaceMessage
from fibaction.interfaces.structs import make_structs
from fibaction.words.errors import TransportError
from fibaction_transports.cdr.codec import CdrCodec
from fibaction_transports.cdr.standard_messages import (
    MESSAGES,
    STRUCTS,
    TimeMessage,
    UuidMessage,
    composed,
)


class SendGoalRequest(Struct):
    """The request that sends a goal."""

    goal_id: UuidMessage
    goal: Any


class SendGoalResponse(Struct):
    """The answer to a goal: whether it is accepted, and when it was."""

    accepted: bool
    stamp: TimeMessage


class GetResultRequest(Struct):
    """The request for a result, which is answered when the goal has ended."""

    goal_id: UuidMessage


class GetResultResponse(Struct):
    """The status in which a goal has ended, and its result."""

    status: int
    result: Any


class FeedbackMessage(Struct):
    """A feedback message of one goal."""

    goal_id: UuidMessage
    feedback: Any


def action_interface(action: ActionFile) -> InterfaceMessage:
    """Return an action as a type of ROS, whose hash is that of the action.

    Its `nested` has the goal, the result, the feedback and the `feedback_message`, and the services
    `send_goal_service` and `get_result_service`. A service nests its `request_message`, its
    `response_message` and its `event_message`.

    Raises:
        TransportError: The type of the action is unknown.
    """
    name = action.type_name
    if not name:
        raise TransportError(
            f"{action.path} has no type name such as 'example_interfaces/action/Fibonacci', which"
            " ROS needs: put it into package/action/, or give it a type_name"
        )
    parts = MESSAGES | {"Goal": action.goal, "Result": action.result, "Feedback": action.feedback}
    parts["SendGoal"] = service_interface(
        f"{name}_SendGoal",
        composed(f"{name}_SendGoal_Request", "UUID goal_id\nGoal goal", parts),
        composed(f"{name}_SendGoal_Response", "bool accepted\nTime stamp", parts),
    )
    parts["GetResult"] = service_interface(
        f"{name}_GetResult",
        composed(f"{name}_GetResult_Request", "UUID goal_id", parts),
        composed(f"{name}_GetResult_Response", "int8 status\nResult result", parts),
    )
    parts["FeedbackMessage"] = composed(
        f"{name}_FeedbackMessage", "UUID goal_id\nFeedback feedback", parts
    )
    text = (
        "Goal goal\nResult result\nFeedback feedback\n"
        "SendGoal send_goal_service\nGetResult get_result_service\n"
        "FeedbackMessage feedback_message"
    )
    return composed(name, text, parts)


def service_interface(
    name: str, request: InterfaceMessage, response: InterfaceMessage
) -> InterfaceMessage:
    """Return a service as a type of ROS, whose hash is that of the service."""
    parts = MESSAGES | {"Request": request, "Response": response}
    event = "ServiceEventInfo info\nRequest[<=1] request\nResponse[<=1] response"
    parts["Event"] = composed(f"{name}_Event", event, parts)
    text = "Request request_message\nResponse response_message\nEvent event_message"
    return composed(name, text, parts)


CANCEL_GOAL: Final = service_interface(
    "action_msgs/srv/CancelGoal", MESSAGES["CancelGoal_Request"], MESSAGES["CancelGoal_Response"]
)
"""The service that cancels goals, the same for all actions."""


def standard_codec(name: str) -> CdrCodec:
    """Return the codec of a message in `MESSAGES`, for example of `GoalStatusArray`."""
    return CdrCodec(MESSAGES[name], STRUCTS)


class ActionCodecs:
    """The codecs of the messages that are an action's own.

    Those that all actions have in common, such as a cancel, are made by `standard_codec`.
    """

    def __init__(self, action: ActionFile, *, as_arrays: bool = False) -> None:
        """Compile them; `as_arrays` is that of `CdrCodec`.

        Raises:
            TransportError: The type of the action is unknown.
        """
        self.interface = action_interface(action)
        self.structs = make_structs(action)
        """The structs of goal, result, feedback and what they nest, by class name."""
        nested = self.interface.nested
        name = self.interface.type_name
        structs: dict[str, Callable[..., Any]] = {
            **STRUCTS,
            **self.structs,
            f"{name}_SendGoal_Request": SendGoalRequest,
            f"{name}_SendGoal_Response": SendGoalResponse,
            f"{name}_GetResult_Request": GetResultRequest,
            f"{name}_GetResult_Response": GetResultResponse,
            f"{name}_FeedbackMessage": FeedbackMessage,
        }

        def codec(message: InterfaceMessage) -> CdrCodec:
            return CdrCodec(message, structs, as_arrays=as_arrays)

        send_goal, get_result = nested["send_goal_service"], nested["get_result_service"]
        self.send_goal_request = codec(send_goal.nested["request_message"])
        self.send_goal_response = codec(send_goal.nested["response_message"])
        self.get_result_request = codec(get_result.nested["request_message"])
        self.get_result_response = codec(get_result.nested["response_message"])
        self.feedback_message = codec(nested["feedback_message"])

"""The messages of an action over DDS, as the halves of the transport use them."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Final

from fibaction.interfaces.files import ActionFile
from fibaction_transports.cdr.action_messages import (
    ActionCodecs,
    FeedbackMessage,
    GetResultRequest,
    GetResultResponse,
    SendGoalRequest,
    SendGoalResponse,
    standard_codec,
)
from fibaction_transports.cdr.codec import CdrCodec
from fibaction_transports.cdr.standard_messages import (
    MESSAGES,
    STRUCTS,
    TimeMessage,
    UuidMessage,
    composed,
)
from fibaction_transports.ros2.convert.conversion import RosAction
from fibaction_transports.ros2.on_dds.messages.message_kinds import message_kind
from fibaction_transports.ros2.on_dds.messages.message_type import MessageType, ServiceType
from fibaction_transports.ros2.on_dds.messages.partly_known import PartlyKnownAction


@cache
def standard_type(name: str) -> MessageType:
    """Return the type of a message that `cdr.standard_messages` has, by its name there."""
    definition = MESSAGES[name]
    return MessageType(definition, standard_codec(name), STRUCTS[definition.type_name])


CANCEL_GOAL: Final = ServiceType(
    standard_type("CancelGoal_Request"), standard_type("CancelGoal_Response")
)


_STATUS: Final = composed("fibaction/msg/ResultStatus", "int8 status", {})


def _without_result(status: int) -> GetResultResponse:
    return GetResultResponse(status, None)


_STATUS_ONLY: Final = CdrCodec(_STATUS, {_STATUS.class_name: _without_result})
"""The codec of answers whose results cannot be read: these follow the status."""


def action_of(file: ActionFile, advice: str = "") -> RosAction:
    """Return the type of an action from its interface file.

    With an `advice`, only the feedback of the file is known: it says what makes the rest known.

    Raises:
        TransportError: The file has no type name of ROS.
    """
    is_known = not advice
    codecs = ActionCodecs(file, as_arrays=True)
    parts = codecs.interface.nested
    send_goal, get_result = parts["send_goal_service"].nested, parts["get_result_service"].nested
    goal, result, feedback = (
        codecs.structs[part.class_name] for part in (file.goal, file.result, file.feedback)
    )
    impl = SimpleNamespace(
        SendGoalService=ServiceType(
            MessageType(
                send_goal["request_message"],
                codecs.send_goal_request,
                lambda: SendGoalRequest(UuidMessage(), goal()),
                is_known=is_known,
            ),
            MessageType(
                send_goal["response_message"],
                codecs.send_goal_response,
                lambda: SendGoalResponse(accepted=False, stamp=TimeMessage()),
            ),
        ),
        GetResultService=ServiceType(
            MessageType(
                get_result["request_message"],
                codecs.get_result_request,
                lambda: GetResultRequest(UuidMessage()),
            ),
            MessageType(
                get_result["response_message"],
                codecs.get_result_response if is_known else _STATUS_ONLY,
                lambda: GetResultResponse(0, result()),
                is_known=is_known,
            ),
        ),
        CancelGoalService=CANCEL_GOAL,
        FeedbackMessage=MessageType(
            parts["feedback_message"],
            codecs.feedback_message,
            lambda: FeedbackMessage(UuidMessage(), feedback()),
            action=codecs.interface if is_known else None,
        ),
        GoalStatusMessage=standard_type("GoalStatusArray"),
    )
    kinds = [message_kind(part, codecs.structs) for part in (file.goal, file.feedback, file.result)]
    if not is_known:
        return PartlyKnownAction(file.type_name, impl, kinds, advice)
    return RosAction(file.type_name, impl, kinds)

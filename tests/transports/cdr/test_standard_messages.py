"""The messages of ROS for actions, compared with the bytes of ROS."""

from __future__ import annotations

from typing import Any

import pytest

from fibaction import TransportError
from fibaction.interfaces import read_action
from fibaction_transports.cdr.codec import CdrCodec
from fibaction_transports.cdr.standard_messages import (
    ActionCodecs,
    CancelGoalRequest,
    CancelGoalResponse,
    FeedbackMessage,
    GetResultRequest,
    GetResultResponse,
    GidMessage,
    GoalInfoMessage,
    GoalStatusArray,
    GoalStatusMessage,
    NodeEntitiesInfo,
    ParticipantEntitiesInfo,
    SendGoalRequest,
    SendGoalResponse,
    TimeMessage,
    UuidMessage,
    action_interface,
    standard_codec,
)
from tests.transports.cdr.definitions import TESTS, action_of
from tests.transports.cdr.recorded import recorded

FIBONACCI = ActionCodecs(
    read_action(TESTS.parent / "examples/ros2/arduinobot_msgs/action/Fibonacci.action")
)
STRUCTS: dict[str, Any] = {**FIBONACCI.structs}
ONE, TWO = UuidMessage(bytes(range(1, 17))), UuidMessage(bytes(range(17, 33)))

MESSAGES: list[tuple[str, CdrCodec, Any]] = [
    (
        "SendGoal_Request",
        FIBONACCI.send_goal_request,
        SendGoalRequest(ONE, STRUCTS["Fibonacci_Goal"](order=10)),
    ),
    (
        "SendGoal_Response",
        FIBONACCI.send_goal_response,
        SendGoalResponse(accepted=True, stamp=TimeMessage(5, 6)),
    ),
    ("GetResult_Request", FIBONACCI.get_result_request, GetResultRequest(ONE)),
    (
        "GetResult_Response",
        FIBONACCI.get_result_response,
        GetResultResponse(4, STRUCTS["Fibonacci_Result"](sequence=[0, 1, 1, -1])),
    ),
    (
        "FeedbackMessage",
        FIBONACCI.feedback_message,
        FeedbackMessage(ONE, STRUCTS["Fibonacci_Feedback"](partial_sequence=[0, 1, 1, 2])),
    ),
    (
        "CancelGoal_Request",
        standard_codec("CancelGoal_Request"),
        CancelGoalRequest(GoalInfoMessage(ONE, TimeMessage(7, 8))),
    ),
    (
        "CancelGoal_Response",
        standard_codec("CancelGoal_Response"),
        CancelGoalResponse(2, [GoalInfoMessage(ONE), GoalInfoMessage(TWO, TimeMessage(1, 2))]),
    ),
    (
        "GoalStatusArray",
        standard_codec("GoalStatusArray"),
        GoalStatusArray(
            [
                GoalStatusMessage(GoalInfoMessage(ONE, TimeMessage(1, 2)), 2),
                GoalStatusMessage(GoalInfoMessage(TWO, TimeMessage(3, 4)), 5),
            ]
        ),
    ),
    (
        "ParticipantEntitiesInfo",
        standard_codec("ParticipantEntitiesInfo"),
        ParticipantEntitiesInfo(
            GidMessage(bytes(range(16))), [NodeEntitiesInfo("/", "kil", [GidMessage()], [])]
        ),
    ),
]


@pytest.mark.parametrize(("name", "codec", "value"), MESSAGES, ids=[name for name, *_ in MESSAGES])
def test_a_message_of_ros_is_read_and_written(name: str, codec: CdrCodec, value: Any) -> None:
    assert codec.decode(recorded(name)) == value
    assert codec.decode(recorded(name, gap="ff")) == value
    encoded = codec.encode(value)
    assert encoded[4:].startswith(recorded(name)[4:])
    assert len(encoded) % 4 == 0
    assert codec.type_name.endswith(name)


def test_an_error_names_the_message_of_the_action() -> None:
    request = SendGoalRequest(ONE, STRUCTS["Fibonacci_Goal"](order=2**31))
    with pytest.raises(ValueError, match=r"Fibonacci_SendGoal_Request\.goal\.order: 2147483648"):
        FIBONACCI.send_goal_request.encode(request)


def test_an_action_that_nests_messages_of_the_same_names_has_its_own() -> None:
    text = "UUID id\nbuiltin_interfaces/Time time\n---\n---\n"
    codecs = ActionCodecs(action_of(text, {"made_msgs/UUID": "int8 number"}))
    structs: dict[str, Any] = {**codecs.structs}
    goal = structs["Made_Goal"](id=structs["UUID"](number=5), time=structs["Time"](sec=1))
    request = SendGoalRequest(ONE, goal)
    payload = codecs.send_goal_request.encode(request)
    assert payload[20:].hex() == "05000000" + "01000000" + "00000000"
    assert codecs.send_goal_request.decode(payload) == request


def test_arrays_of_numbers_may_be_arrays() -> None:
    codecs = ActionCodecs(action_of("---\n---\nint8[] grid\n"), as_arrays=True)
    structs: dict[str, Any] = {**codecs.structs}
    message = FeedbackMessage(ONE, structs["Made_Feedback"](grid=[1, -1]))
    decoded = codecs.feedback_message.decode(codecs.feedback_message.encode(message))
    assert decoded.feedback.grid.typecode == "b"


def test_an_action_without_a_type_name_is_not_one_of_ros() -> None:
    action = action_of("---\n---\n")._replace(type_name="")
    with pytest.raises(TransportError, match="has no type name such as"):
        action_interface(action)

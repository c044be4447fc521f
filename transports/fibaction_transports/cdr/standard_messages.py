"""The messages of ROS that every action uses, those that it makes of the messages of an action, and
those that tell which nodes a participant has.

Each has a struct with the fields of ROS. Those that are the same for all actions have a definition,
for the codec and the type hash; the requests and responses of the services `SendGoal` and
`GetResult`, and the `FeedbackMessage`, have codecs that are made for each action.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from msgspec import Struct, field

from fibaction.interfaces.files import ActionFile, InterfaceMessage
from fibaction.interfaces.parser import parse_message
from fibaction.interfaces.structs import make_structs
from fibaction.words.errors import TransportError
from fibaction_transports.cdr.codec import CdrCodec


class UuidMessage(Struct):
    """A `unique_identifier_msgs/msg/UUID`."""

    uuid: bytes = bytes(16)


class TimeMessage(Struct):
    """A `builtin_interfaces/msg/Time`."""

    sec: int = 0
    nanosec: int = 0


class GoalInfoMessage(Struct):
    """An `action_msgs/msg/GoalInfo`."""

    goal_id: UuidMessage = field(default_factory=UuidMessage)
    stamp: TimeMessage = field(default_factory=TimeMessage)


class GoalStatusMessage(Struct):
    """An `action_msgs/msg/GoalStatus`."""

    goal_info: GoalInfoMessage = field(default_factory=GoalInfoMessage)
    status: int = 0


class GoalStatusArray(Struct):
    """An `action_msgs/msg/GoalStatusArray`."""

    status_list: list[GoalStatusMessage] = []


class CancelGoalRequest(Struct):
    """The request of `action_msgs/srv/CancelGoal`."""

    goal_info: GoalInfoMessage = field(default_factory=GoalInfoMessage)


class CancelGoalResponse(Struct):
    """The response of `action_msgs/srv/CancelGoal`."""

    return_code: int = 0
    goals_canceling: list[GoalInfoMessage] = []


class GidMessage(Struct):
    """An `rmw_dds_common/msg/Gid`: the GUID of a participant or an endpoint."""

    data: bytes = bytes(16)


class NodeEntitiesInfo(Struct):
    """An `rmw_dds_common/msg/NodeEntitiesInfo`: a node and its endpoints."""

    node_namespace: str = ""
    node_name: str = ""
    reader_gid_seq: list[GidMessage] = []
    writer_gid_seq: list[GidMessage] = []


class ParticipantEntitiesInfo(Struct):
    """An `rmw_dds_common/msg/ParticipantEntitiesInfo`: a participant and its nodes."""

    gid: GidMessage = field(default_factory=GidMessage)
    node_entities_info_seq: list[NodeEntitiesInfo] = []


def composed(type_name: str, text: str, parts: Mapping[str, InterfaceMessage]) -> InterfaceMessage:
    """Return a message of a package from the text of its definition.

    The text names the messages in it as `parts` does: without package.
    """
    # Its text is left out, because in a file the packages are needed.
    definition = parse_message(text, Path(type_name))._replace(text="")
    nested = {
        each.name: parts[each.type.base] for each in definition.fields if each.type.is_message
    }
    package = type_name.partition("/")[0]
    # The full name is no name of a class, so no message of an interface file has it.
    return InterfaceMessage(type_name, f"`{type_name}`", package, definition, nested, type_name)


# Each message comes after those that it nests.
_DEFINED: tuple[tuple[str, str, Callable[..., Any] | None], ...] = (
    ("unique_identifier_msgs/msg/UUID", "uint8[16] uuid", UuidMessage),
    ("builtin_interfaces/msg/Time", "int32 sec\nuint32 nanosec", TimeMessage),
    (
        "service_msgs/msg/ServiceEventInfo",
        "uint8 event_type\nTime stamp\nchar[16] client_gid\nint64 sequence_number",
        None,  # for type hashes only
    ),
    ("action_msgs/msg/GoalInfo", "UUID goal_id\nTime stamp", GoalInfoMessage),
    ("action_msgs/msg/GoalStatus", "GoalInfo goal_info\nint8 status", GoalStatusMessage),
    ("action_msgs/msg/GoalStatusArray", "GoalStatus[] status_list", GoalStatusArray),
    ("action_msgs/srv/CancelGoal_Request", "GoalInfo goal_info", CancelGoalRequest),
    (
        "action_msgs/srv/CancelGoal_Response",
        "int8 return_code\nGoalInfo[] goals_canceling",
        CancelGoalResponse,
    ),
    ("rmw_dds_common/msg/Gid", "char[16] data", GidMessage),
    (
        "rmw_dds_common/msg/NodeEntitiesInfo",
        (
            "string<=256 node_namespace\nstring<=256 node_name\n"
            "Gid[] reader_gid_seq\nGid[] writer_gid_seq"
        ),
        NodeEntitiesInfo,
    ),
    (
        "rmw_dds_common/msg/ParticipantEntitiesInfo",
        "Gid gid\nNodeEntitiesInfo[] node_entities_info_seq",
        ParticipantEntitiesInfo,
    ),
)

MESSAGES: Final[dict[str, InterfaceMessage]] = {}
"""The definitions, by the names without packages."""
for _type_name, _text, _ in _DEFINED:
    MESSAGES[_type_name.rpartition("/")[2]] = composed(_type_name, _text, MESSAGES)

STRUCTS: Final[dict[str, Callable[..., Any]]] = {
    type_name: struct for type_name, _, struct in _DEFINED if struct is not None
}
"""The structs, by the names of their types."""


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

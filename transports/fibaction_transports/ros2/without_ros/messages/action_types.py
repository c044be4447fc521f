"""The messages of an action without ROS, as the halves of the transport use them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from types import SimpleNamespace
from typing import Any, Final

import msgspec

from fibaction.interfaces.definitions import FieldType
from fibaction.interfaces.files import ActionFile, InterfaceMessage, read_action_texts
from fibaction.types.action import ActionInfo
from fibaction.words.errors import TransportError
from fibaction_transports.cdr.codec import CdrCodec
from fibaction_transports.cdr.standard_messages import (
    MESSAGES,
    STRUCTS,
    ActionCodecs,
    FeedbackMessage,
    GetResultRequest,
    GetResultResponse,
    SendGoalRequest,
    SendGoalResponse,
    TimeMessage,
    UuidMessage,
    composed,
    standard_codec,
)
from fibaction_transports.ros2.convert.conversion import RosAction, RosCodec, RosCodecs
from fibaction_transports.ros2.convert.fields import SINGLES, Kind, array_kind, text_kind
from fibaction_transports.ros2.convert.message_types import DurationKind, MessageKind, TimeKind
from fibaction_transports.ros2.without_ros.messages.message_type import MessageType, ServiceType

_NIL = msgspec.msgpack.encode(None)


class PartlyKnownAction(RosAction):
    """An action whose goal and result are not known: its goals are followed, and none is sent."""

    def __init__(
        self,
        type_name: str,
        impl: Any,
        kinds: Sequence[MessageKind],
        problem: str,
        *,
        has_feedback: bool = True,
    ) -> None:
        """Describe it. `problem` says what is not known, and what makes it known. Without
        `has_feedback`, the feedback is not known, either.
        """
        super().__init__(type_name, impl, kinds)
        self.problem = problem
        self._has_feedback = has_feedback

    def info(self, name: str) -> ActionInfo:
        feedback = super().info(name).feedback if self._has_feedback else {}
        return ActionInfo(name, self.type_name, feedback=feedback)

    def codecs(self, info: ActionInfo) -> RosCodecs:
        if info.goal or info.result or (info.feedback and not self._has_feedback):
            raise TransportError(self.problem)
        unknown = _UnknownPart()
        feedback = super().codecs(info).feedback if self._has_feedback else unknown
        return RosCodecs(_UnknownGoal(self.problem), feedback, unknown)


class _UnknownGoal(RosCodec):
    """The codec of goals that cannot be made."""

    def __init__(self, problem: str) -> None:
        self._problem = problem

    def to_ros(self, payload: bytes | None) -> Any:
        raise TransportError(self._problem)


class _UnknownPart(RosCodec):
    """The codec of results, or of feedback, that cannot be read: each is None."""

    def __init__(self) -> None:
        pass

    def to_ros(self, payload: bytes | None) -> Any:
        return None

    def from_ros(self, message: Any) -> bytes:
        return _NIL


_CHAR = "uint8"
"""The type that ROS 2 has for a `char`."""
_TEXTS = {"string": False, "wstring": True}
_TIMES = {
    "builtin_interfaces/msg/Time": TimeKind,
    "builtin_interfaces/msg/Duration": DurationKind,
}


def message_kind(
    message: InterfaceMessage, structs: Mapping[str, type[msgspec.Struct]]
) -> MessageKind:
    """Return the kind of a message whose structs are those of `make_structs`."""
    fields: dict[str, Kind] = {}
    for field in message.definition.fields:
        nested, kind = message.nested.get(field.name), field.type
        single = _single_kind(kind) if nested is None else message_kind(nested, structs)
        is_array = kind.is_array
        fields[field.name] = array_kind(single, kind.size, kind.bound) if is_array else single
    cls = structs[message.class_name]
    name = f"{message.package}/{message.definition.name}"
    return _TIMES.get(message.type_name, MessageKind)(name, cls, fields, cls)


def _single_kind(kind: FieldType) -> Kind:
    if kind.base in _TEXTS:
        return text_kind(_TEXTS[kind.base], kind.characters)
    return SINGLES.get(kind.base, SINGLES[_CHAR])


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


_GOAL_ID: Final = composed("fibaction/msg/FeedbackGoal", "UUID goal_id", MESSAGES)


def _without_feedback(goal_id: UuidMessage) -> FeedbackMessage:
    return FeedbackMessage(goal_id, None)


_GOAL_ID_ONLY: Final = CdrCodec(_GOAL_ID, {**STRUCTS, _GOAL_ID.class_name: _without_feedback})
"""The codec of feedback that cannot be read: it follows the ID of the goal."""


def unknown_action(type_name: str, problem: str) -> PartlyKnownAction:
    """Return an action for which only the name of its type is known: its goals are listed,
    canceled and followed to their ends. `problem` says so, and what makes it known.
    """
    known = action_of(read_action_texts(type_name, {type_name: "---\n---\n"}), problem)
    feedback = known.impl.FeedbackMessage
    known.impl.FeedbackMessage = MessageType(
        feedback.definition, _GOAL_ID_ONLY, feedback, is_known=False
    )
    return PartlyKnownAction(type_name, known.impl, [], problem, has_feedback=False)


def action_of(file: ActionFile, problem: str = "") -> RosAction:
    """Return the type of an action from its interface file.

    With a `problem`, only the feedback of the file is known: it says so, and what makes the rest
    known.

    Raises:
        TransportError: The file has no type name of ROS.
    """
    is_known = not problem
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
        return PartlyKnownAction(file.type_name, impl, kinds, problem)
    return RosAction(file.type_name, impl, kinds)

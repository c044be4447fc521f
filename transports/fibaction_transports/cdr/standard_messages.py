"""The messages of ROS that every action uses, and those that tell which nodes a participant has.

Each has its definition, for the codec and the type hash, and a struct with the fields of ROS.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from msgspec import Struct, field

from fibaction.interfaces.files import InterfaceMessage
from fibaction.interfaces.parser import parse_message


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

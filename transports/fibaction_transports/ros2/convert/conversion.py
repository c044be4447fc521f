"""Conversion between payloads and ROS messages.

`RosAction` finds a ROS action type, and its codecs convert its messages. A payload is msgpack, and
a struct in it is a map by field name. The JSON Schemas in the description of an action tell what
the user's end expects. Where they say nothing, ROS's own field names, numbers, strings and lists
are used, and bytes for arrays of bytes. No node is needed.
"""

from __future__ import annotations

import re
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import msgspec

from fibaction.border.peer_text import excerpt
from fibaction.types.action import ActionInfo
from fibaction.words.errors import ProtocolError, TransportError
from fibaction.words.goals import GoalID, GoalInfo
from fibaction_transports.ros2.convert.fields import Unfit
from fibaction_transports.ros2.convert.message_types import MessagePart, message_kind
from fibaction_transports.ros2.convert.schemas import UserSchema
from fibaction_transports.ros2.rcl import GoalInfoMessage, check_for_type_support, uuid_of

_TYPE_NAME = re.compile(r"[a-z][a-z0-9_]*/action/[A-Z][A-Za-z0-9]*", re.ASCII)

_PARTS = ("goal", "feedback", "result")
_REMEMBERED = 64
"""Descriptions of one type whose codecs are kept. A program has a few."""

_encode = msgspec.msgpack.Encoder().encode


class RosCodec:
    """Converts one of an action's three messages, in both directions."""

    def __init__(self, part: MessagePart) -> None:
        self._part = part
        self._decode = msgspec.msgpack.Decoder(part.decoded).decode

    def to_ros(self, payload: bytes | None) -> Any:
        """Make a ROS message; None gives the message with its defaults.

        A field that the payload leaves out has the user's default, or else ROS's.

        Raises:
            ProtocolError: The payload is not such a message, or a value does not fit; the text
                names the field.
        """
        message = self._part.cls()
        if payload is not None:
            self.fill(message, payload)
        return message

    def fill(self, message: Any, payload: bytes) -> None:
        """Set the fields of a ROS message. After an error, the message must not be used.

        Raises:
            ProtocolError: As for `to_ros`.
        """
        try:
            self._part.fill(message, self._decode(payload))
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, Unfit) as exc:
            raise ProtocolError(excerpt(str(exc))) from exc

    def from_ros(self, message: Any) -> bytes:
        """Make a payload as the user's end expects it."""
        return _encode(self._part.values(message))


class RosCodecs(NamedTuple):
    """The codecs of one action."""

    goal: RosCodec
    feedback: RosCodec
    result: RosCodec


class RosAction:
    """One ROS action type."""

    def __init__(self, type_name: str, ros_type: Any) -> None:
        """Look at the type. `find` does it once for each type."""
        self.type_name = type_name
        self.ros_type = ros_type
        """The generated class: `pkg.action.Type`."""
        self._kinds = [message_kind(getattr(ros_type, name.title())) for name in _PARTS]
        self._codecs: dict[str, RosCodecs] = {}

    @classmethod
    def find(cls, type_name: str, action: str = "") -> RosAction:
        """Find a type by its name, for example `example_interfaces/action/Fibonacci`.

        `action` is the name of an action of this type, for errors.

        Raises:
            TransportError: There is no such type that can be used; the text says what to do.
        """
        if not _TYPE_NAME.fullmatch(type_name):
            which = f" {action!r}" if action else ""
            raise TransportError(
                f"give the Action{which} a type_name such as"
                " 'example_interfaces/action/Fibonacci',"
                f" which ROS needs: {type_name!r} is not a ROS action type"
            )
        return _found(type_name)

    @property
    def types(self) -> tuple[type[Any], type[Any], type[Any]]:
        """Structs for the goal, the feedback and the result, made from the ROS type."""
        goal, feedback, result = (kind.default for kind in self._kinds)
        return goal, feedback, result

    def info(self, name: str) -> ActionInfo:
        """Return the description of an action, for users without types of their own."""
        return ActionInfo(name, self.type_name, *map(msgspec.json.schema, self.types))

    def codecs(self, info: ActionInfo) -> RosCodecs:
        """Return the codecs for the types of an action's users.

        Raises:
            TransportError: Fields do not match; the text lists all of them.
        """
        try:
            key = repr(info)
            if key not in self._codecs:
                if len(self._codecs) == _REMEMBERED:
                    self._codecs.clear()
                self._codecs[key] = self._bound(info)
        except RecursionError as exc:  # the description may come from another process
            raise TransportError(f"the types of action {info.name!r} are nested too deep") from exc
        return self._codecs[key]

    def _bound(self, info: ActionInfo) -> RosCodecs:
        problems: list[str] = []
        parts = [
            kind.bind(UserSchema(getattr(info, name)), name, problems)
            for kind, name in zip(self._kinds, _PARTS, strict=True)
        ]
        codecs = [RosCodec(part) for part in parts if isinstance(part, MessagePart)]
        if problems:
            lines = ";\n  ".join(problems)
            raise TransportError(
                f"action {info.name!r} does not match its ROS type {self.type_name}:\n  {lines}"
            )
        return RosCodecs(*codecs)


def message_types(type_name: str) -> tuple[type[Any], type[Any], type[Any]]:
    """Return structs for the goal, the feedback and the result of a ROS action type.

    Raises:
        TransportError: As for `RosAction.find`.
    """
    return RosAction.find(type_name).types


@cache
def _found(type_name: str) -> RosAction:
    package, _, name = type_name.split("/")
    actions = _actions_of(package, type_name)
    if not hasattr(actions, name):
        raise TransportError(
            f"the ROS package {package!r}, as it is built here, has no action {name!r}:"
            f" look at its .action files, and build it again"
        )
    ros_type = getattr(actions, name)
    try:
        check_for_type_support(ros_type)
    except Exception as exc:  # loading compiled code may raise anything
        raise TransportError(
            f"{type_name} cannot be used, because its compiled part cannot be loaded ({exc}):"
            f" build the ROS package {package!r} again, for this ROS and this Python"
        ) from exc
    return RosAction(type_name, ros_type)


def _actions_of(package: str, type_name: str) -> Any:
    """Return the module with the actions of a ROS package."""
    try:
        spec = find_spec(package)
        # To Python, a folder of sources that are not built is a package, too: one without a file.
        if spec is not None and spec.origin is not None:
            return import_module(f"{package}.action")
    except Exception as exc:  # importing a module may raise anything
        if isinstance(exc, ModuleNotFoundError) and exc.name == f"{package}.action":
            raise TransportError(f"the ROS package {package!r} has no actions") from exc
        raise TransportError(
            f"{type_name} cannot be imported ({exc}): source the setup.bash of ROS and of what it"
            " needs"
        ) from exc
    raise TransportError(
        f"the ROS package {package!r}, which has {type_name}, is not installed here:"
        " build it, and source its setup.bash"
    )


# Messages that all actions have in common


def goal_id_of(message: Any) -> GoalID:
    """Return the goal ID of a `unique_identifier_msgs/msg/UUID`."""
    return GoalID(bytes(message.uuid))


def stamp_of(message: Any) -> int:
    """Return the nanoseconds since 1970 of a `builtin_interfaces/msg/Time`."""
    stamp: int = message.sec * 10**9 + message.nanosec
    return stamp


def goal_info_to_ros(info: GoalInfo) -> Any:
    """Return the `action_msgs/msg/GoalInfo` of a goal. It has no field for the status."""
    message = GoalInfoMessage()
    message.goal_id.uuid = uuid_of(info.goal_id)
    message.stamp.sec, message.stamp.nanosec = divmod(info.stamp, 10**9)
    return message

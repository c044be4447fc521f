"""Conversion between payloads and ROS messages.

The codecs of a `RosAction` convert its messages. A payload is msgpack, and a struct in it is a map
by field name. The JSON Schemas in the description of an action tell what the user's end expects.
Where they say nothing, ROS's own field names, numbers, strings and lists are used, and bytes for
arrays of bytes. No node is needed.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import msgspec

from fibaction.border.peer_text import excerpt
from fibaction.types.action import ActionInfo
from fibaction.types.schemas import schema_of
from fibaction.words.errors import ProtocolError, TransportError
from fibaction.words.goals import GoalID
from fibaction_transports.ros2.convert.fields import Unfit
from fibaction_transports.ros2.convert.message_types import (
    MessageKind,
    MessagePart,
    interface_texts,
)
from fibaction_transports.ros2.convert.schemas import UserSchema

_PARTS = ("goal", "feedback", "result")
_TYPE_NAME = re.compile(r"[a-z][a-z0-9_]*/action/[A-Z][A-Za-z0-9]*", re.ASCII)
_REMEMBERED = 64
"""Descriptions of one type whose codecs are kept. A program has a few."""

_encode = msgspec.msgpack.Encoder().encode


def is_action_type(type_name: str) -> bool:
    """Return whether this is the name of a type of actions, `package/action/Type`."""
    return _TYPE_NAME.fullmatch(type_name) is not None


def check_action_type(type_name: str, action: str) -> None:
    """Check the name of a type of actions; `action` is the name of one, for the error.

    Raises:
        TransportError: It is not such a name.
    """
    if not is_action_type(type_name):
        which = f" {action!r}" if action else ""
        raise TransportError(
            f"give the Action{which} a type_name such as 'example_interfaces/action/Fibonacci',"
            f" which ROS needs: {type_name!r} is not a ROS action type"
        )


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

    def __init__(self, type_name: str, impl: Any, kinds: Sequence[MessageKind]) -> None:
        """Describe the type. `kinds` are those of the goal, the feedback and the result."""
        self.type_name = type_name
        self.impl = impl
        """The types of its messages: `SendGoalService`, `GetResultService` and `CancelGoalService`,
        which have a `Request` and a `Response`; `FeedbackMessage` and `GoalStatusMessage`."""
        self._kinds = kinds
        self._codecs: dict[str, RosCodecs] = {}

    @property
    def types(self) -> tuple[type[Any], type[Any], type[Any]]:
        """Structs for the goal, the feedback and the result, made from the ROS type."""
        goal, feedback, result = (kind.default for kind in self._kinds)
        return goal, feedback, result

    @property
    def classes(self) -> tuple[Any, Any, Any]:
        """The classes of the messages of the goal, the feedback and the result."""
        goal, feedback, result = (kind.cls for kind in self._kinds)
        return goal, feedback, result

    def info(self, name: str) -> ActionInfo:
        """Return the description of an action, for users without types of their own."""
        return ActionInfo(name, self.type_name, *map(schema_of, self.types))

    def texts(self) -> dict[str, str]:
        """Return the texts of interface files that define the type: see `interface_texts`."""
        return interface_texts(self.type_name, *self._kinds)

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


# Messages that all actions have in common


def goal_id_of(message: Any) -> GoalID:
    """Return the goal ID of a `unique_identifier_msgs/msg/UUID`."""
    return GoalID(bytes(message.uuid))


def stamp_of(message: Any) -> int:
    """Return the nanoseconds since 1970 of a `builtin_interfaces/msg/Time`."""
    stamp: int = message.sec * 10**9 + message.nanosec
    return stamp

"""Definitions of messages for the tests of CDR, from the texts of their files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fibaction.interfaces import ActionFile, make_structs
from fibaction.interfaces.files import InterfaceMessage, read_action_texts
from fibaction_transports.cdr.codec import CdrCodec

TESTS = Path(__file__).parents[2]

MADE = "made_msgs/action/Made"
NONE: Mapping[str, str] = {}

POSES = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    "geometry_msgs/Pose": "Point position\nQuaternion orientation",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\nPose pose",
}


def action_of(text: str, messages: Mapping[str, str] = NONE) -> ActionFile:
    """Return the action `made_msgs/action/Made` with this text.

    `messages` are the texts of messages in it, by names such as `geometry_msgs/Pose`.
    """
    texts = {name.replace("/", "/msg/"): definition for name, definition in messages.items()}
    return read_action_texts(MADE, {MADE: text} | texts)


class Goal:
    """The goal of an action, with its struct and its codec."""

    def __init__(self, text: str, messages: Mapping[str, str] = NONE, **options: Any) -> None:
        action = action_of(f"{text}\n---\n---\n", messages)
        self.message = action.goal
        self.structs: dict[str, Any] = {**make_structs(action)}
        self.type = self.structs["Made_Goal"]
        self.codec = CdrCodec(self.message, self.structs, **options)

    def encoded(self, **fields: Any) -> bytes:
        """Return a goal with these fields as a payload."""
        return self.codec.encode(self.type(**fields))

    def body(self, **fields: Any) -> str:
        """Return a goal with these fields as hexadecimal digits, without the header."""
        return self.encoded(**fields)[4:].hex()

    def decoded(self, body: str, header: str = "00010000") -> Any:
        """Return the goal in a body that is given as hexadecimal digits."""
        return self.codec.decode(bytes.fromhex(header + body))


def message_in(name: str, messages: Mapping[str, str]) -> InterfaceMessage:
    """Return a message by its name, for example `geometry_msgs/Pose`."""
    return action_of(f"{name} message\n---\n---\n", messages).goal.nested["message"]

"""The types of actions over DDS: from interface files, which need no ROS."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from fibaction.interfaces import InterfaceError, read_action
from fibaction.interfaces.files import ActionFile, ros_folders
from fibaction.interfaces.known import known_action
from fibaction.words.errors import TransportError
from fibaction_transports.cdr.standard_messages import STRUCTS
from fibaction_transports.ros2.convert.conversion import RosAction
from fibaction_transports.ros2.node.ros_node import RosTypes
from fibaction_transports.ros2.on_dds.messages.action_types import action_of
from fibaction_transports.ros2.on_dds.messages.message_type import MessageType
from fibaction_transports.ros2.on_dds.messages.node_messages import PARAMETER

FOLDERS: Final = "FIBACTION_SEARCH"
"""The variable of the environment with folders of packages, separated as in PATH."""
_TYPE_NAME = re.compile(r"[a-z][a-z0-9_]*/action/[A-Z][A-Za-z0-9]*", re.ASCII)


class DdsTypes(RosTypes):
    """The types whose interface files are found, or were loaded by this program."""

    def __init__(self, folders: Sequence[str | os.PathLike[str]] = ()) -> None:
        """`folders` are searched first, then those of the environment and of ROS."""
        given = filter(None, os.environ.get(FOLDERS, "").split(os.pathsep))
        self._folders = [*map(Path, folders), *map(Path, given)]
        self._found: dict[str, RosAction] = {}
        self.GoalInfo = STRUCTS["action_msgs/msg/GoalInfo"]
        self.Parameter = PARAMETER

    def find(self, type_name: str, action: str = "") -> RosAction:
        if type_name not in self._found:
            self._found[type_name] = action_of(self._file(type_name, action))
        return self._found[type_name]

    def _file(self, type_name: str, action: str) -> ActionFile:
        if not _TYPE_NAME.fullmatch(type_name):
            which = f" {action!r}" if action else ""
            raise TransportError(
                f"give the Action{which} a type_name such as"
                f" 'example_interfaces/action/Fibonacci', which ROS needs: {type_name!r} is not a"
                " ROS action type"
            )
        known = known_action(type_name)
        if known is not None:
            return known
        folders = [*self._folders, *ros_folders()]
        for folder in folders:
            path = folder / f"{type_name}.action"
            if path.is_file():
                try:
                    return read_action(path, type_name=type_name, search=folders)
                except (InterfaceError, OSError) as exc:
                    raise TransportError(f"{type_name} cannot be used: {exc}") from exc
        searched = ", ".join(map(str, folders)) or "no folder"
        raise TransportError(
            f"{type_name} is not known here: put {type_name}.action into a folder, and name that"
            f" folder with search=FOLDER or in {FOLDERS} (searched: {searched})"
        )

    def uuid(self, goal_id: bytes) -> bytes:
        return bytes(goal_id)

    def decode(self, message: bytes, message_type: MessageType) -> Any:
        return message_type.codec.decode(message)

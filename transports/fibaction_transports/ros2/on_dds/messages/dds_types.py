"""The types of actions over DDS: from interface files, which need no ROS."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from fibaction.interfaces import InterfaceError, read_action
from fibaction.interfaces.files import ActionFile, ros_folders
from fibaction.interfaces.known import known_action
from fibaction.words.errors import TransportError
from fibaction_transports.cdr.standard_messages import STRUCTS
from fibaction_transports.ros2.convert.conversion import (
    RosAction,
    check_action_type,
    is_action_type,
)
from fibaction_transports.ros2.node.ros_node import RosTypes, TypeVersion
from fibaction_transports.ros2.on_dds.messages.action_types import action_of
from fibaction_transports.ros2.on_dds.messages.message_type import MessageType
from fibaction_transports.ros2.on_dds.messages.node_messages import PARAMETER
from fibaction_transports.ros2.on_dds.messages.partly_known import PartlyKnownAction

FOLDERS: Final = "FIBACTION_SEARCH"
"""The variable of the environment with folders of packages, separated as in PATH."""
MOST_LEARNED: Final = 1_000
"""Types that are kept as other nodes describe them."""


class _Definition(NamedTuple):
    """A type of actions, and the file that defines it."""

    file: ActionFile
    action: RosAction
    type_hash: str = ""
    """The hash by which another node was asked for it."""


class DdsTypes(RosTypes):
    """The types whose interface files are found, or were loaded by this program."""

    def __init__(self, folders: Sequence[str | os.PathLike[str]] = ()) -> None:
        """`folders` are searched first, then those of the environment and of ROS."""
        given = filter(None, os.environ.get(FOLDERS, "").split(os.pathsep))
        self._folders = [*map(Path, folders), *map(Path, given)]
        self._found: dict[str, _Definition] = {}
        self._learned: OrderedDict[str, _Definition] = OrderedDict()
        """The actions that other nodes have described."""
        self.GoalInfo = STRUCTS["action_msgs/msg/GoalInfo"]
        self.Parameter = PARAMETER

    def find(self, type_name: str, action: str = "") -> RosAction:
        return self._definition(type_name, action).action

    def texts(self, type_name: str) -> dict[str, str]:
        found = self._definition(type_name)
        if isinstance(found.action, PartlyKnownAction):
            raise TransportError(found.action.problem)
        return found.file.texts()

    def _definition(self, type_name: str, action: str = "") -> _Definition:
        if type_name not in self._found:
            check_action_type(type_name, action)
            file = self._file(type_name)
            if file is None and type_name in self._learned:
                return self._learned[type_name]
            if file is None:
                raise TransportError(f"{type_name} is not known here: {self._advice(type_name)}")
            self._found[type_name] = _Definition(file, action_of(file))
        return self._found[type_name]

    def has_file(self, type_name: str) -> bool:
        """Return whether a type needs not be learned: it has a file, or cannot have one."""
        try:
            self.find(type_name)
        except TransportError:
            return not is_action_type(type_name) or self._path(type_name) is not None
        return type_name in self._found

    def has_learned(self, type_name: str, type_hash: str) -> bool:
        """Return whether another node has described a type by this hash."""
        return type_name in self._learned and self._learned[type_name].type_hash == type_hash

    def learn(self, file: ActionFile, type_hash: str, *, is_whole: bool) -> None:
        """Take a type as another node describes it. Without `is_whole`, its goal and its result
        are not known.
        """
        advice = "" if is_whole else self._advice(file.type_name)
        self._learned[file.type_name] = _Definition(file, action_of(file, advice), type_hash)
        if len(self._learned) > MOST_LEARNED:
            self._learned.popitem(last=False)

    def _folders_now(self) -> list[Path]:
        return [*self._folders, *ros_folders()]

    def _path(self, type_name: str) -> Path | None:
        paths = (folder / f"{type_name}.action" for folder in self._folders_now())
        return next((path for path in paths if path.is_file()), None)

    def _file(self, type_name: str) -> ActionFile | None:
        try:
            known = known_action(type_name)
            path = self._path(type_name)
            if known is not None or path is None:
                return known
            return read_action(path, type_name=type_name, search=self._folders_now())
        except (InterfaceError, OSError) as exc:
            raise TransportError(f"{type_name} cannot be used: {exc}") from exc

    def _advice(self, type_name: str) -> str:
        searched = ", ".join(map(str, self._folders_now())) or "no folder"
        return (
            f"put {type_name}.action into a folder, and name that folder with search=FOLDER or in"
            f" {FOLDERS} (searched: {searched}), or import a module that `fibaction -u ros2:// gen"
            " --from-robot` has written where ROS has this type"
        )

    def version(self, message_type: MessageType) -> TypeVersion | None:
        if not message_type.is_known:
            return None
        return TypeVersion(message_type.name, message_type.type_hash)

    def uuid(self, goal_id: bytes) -> bytes:
        return bytes(goal_id)

    def decode(self, message: bytes, message_type: MessageType) -> Any:
        return message_type.codec.decode(message)

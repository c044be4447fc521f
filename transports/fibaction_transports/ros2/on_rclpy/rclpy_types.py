"""The types of ROS that rclpy finds: those whose packages are built and sourced."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from fibaction.interfaces import InterfaceError
from fibaction.interfaces.files import ActionFile, read_action, read_action_texts
from fibaction.interfaces.packages import ros_folders
from fibaction.words.errors import ProtocolError, TransportError, text_of
from fibaction_transports.cdr.standard_messages import action_interface
from fibaction_transports.cdr.type_hashes import type_hash
from fibaction_transports.ros2.convert.conversion import RosAction, check_action_type
from fibaction_transports.ros2.convert.message_classes import message_kind
from fibaction_transports.ros2.node.ros_node import CalledType, RosTypes, TopicType
from fibaction_transports.ros2.on_rclpy.rcl import (
    GoalInfoMessage,
    ParameterMessage,
    check_for_type_support,
    deserialize,
    uuid_of,
)


class RclpyTypes(RosTypes):
    """The generated classes of ROS."""

    GoalInfo = GoalInfoMessage
    Parameter = ParameterMessage

    def find(self, type_name: str, action: str = "") -> RosAction:
        check_action_type(type_name, action)
        return _found(type_name)

    def topic_type(self, type_name: str) -> TopicType:
        message = _interface(type_name, "msg")
        return TopicType(message, message_kind(message))

    def called_type(self, type_name: str) -> CalledType:
        service = _interface(type_name, "srv")
        return CalledType(service, message_kind(service.Request), message_kind(service.Response))

    def texts(self, type_name: str) -> dict[str, str]:
        made = self.find(type_name).texts()
        return _installed_texts(type_name, made) or made

    def uuid(self, goal_id: bytes) -> Any:
        return uuid_of(goal_id)

    def decode(self, message: bytes, message_type: Any) -> Any:
        try:
            return deserialize(message, message_type)
        except Exception as exc:  # rclpy raises whatever rcl says
            raise ProtocolError(text_of(exc)) from exc


def _installed_texts(type_name: str, made: Mapping[str, str]) -> dict[str, str]:
    """Return the texts of the installed files, which have comments, too; empty if there are none,
    or if they define another type than the texts that are made from the classes.
    """
    folders = list(ros_folders())
    paths = (folder / f"{type_name}.action" for folder in folders)
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        return {}
    try:
        file = read_action(path, type_name=type_name, search=folders)
        is_same = _hash(file) == _hash(read_action_texts(type_name, made))
    except (InterfaceError, OSError):
        return {}
    return file.texts() if is_same else {}


def _hash(file: ActionFile) -> str:
    return type_hash(action_interface(file))


@cache
def _found(type_name: str) -> RosAction:
    ros_type = _interface(type_name, "action")
    kinds = [message_kind(one) for one in (ros_type.Goal, ros_type.Feedback, ros_type.Result)]
    return RosAction(type_name, ros_type.Impl, kinds)


_WORDS = {"action": "actions", "msg": "messages", "srv": "services"}


def _interface(type_name: str, folder: str) -> Any:
    """Return the class of a type whose name has this folder in the middle."""
    package, _, name = type_name.partition(f"/{folder}/")
    if not package or not name.isidentifier():
        raise TransportError(f"expected a type like 'package/{folder}/Type', found {type_name!r}")
    module = _module(package, folder, type_name)
    if not hasattr(module, name):
        word = _WORDS[folder].removesuffix("s")
        raise TransportError(
            f"the ROS package {package!r}, as it is built here, has no {word} {name!r}:"
            f" look at its .{folder} files, and build it again"
        )
    ros_type = getattr(module, name)
    try:
        check_for_type_support(ros_type)
    except Exception as exc:  # loading compiled code may raise anything
        raise TransportError(
            f"{type_name} cannot be used, because its compiled part cannot be loaded ({exc}):"
            f" build the ROS package {package!r} again, for this ROS and this Python"
        ) from exc
    return ros_type


def _module(package: str, folder: str, type_name: str) -> Any:
    """Return the module with the types of a ROS package."""
    try:
        spec = find_spec(package)
        # To Python, a folder of sources that are not built is a package, too: one without a file.
        if spec is not None and spec.origin is not None:
            return import_module(f"{package}.{folder}")
    except Exception as exc:  # importing a module may raise anything
        if isinstance(exc, ModuleNotFoundError) and exc.name == f"{package}.{folder}":
            raise TransportError(f"the ROS package {package!r} has no {_WORDS[folder]}") from exc
        raise TransportError(
            f"{type_name} cannot be imported ({exc}): source the setup.bash of ROS and of what it"
            " needs"
        ) from exc
    raise TransportError(
        f"the ROS package {package!r}, which has {type_name}, is not installed here:"
        " build it, and source its setup.bash"
    )

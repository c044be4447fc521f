"""Actions from ROS 2 interface files, without ROS and without a build step."""

from fibaction.interfaces.action_files import (
    InterfaceError,
    action_source,
    load_action,
)
from fibaction.interfaces.known import define_action

__all__ = [
    "InterfaceError",
    "action_source",
    "define_action",
    "load_action",
]

"""Actions from ROS 2 interface files, with no ROS and no build step.

    from fibaction.action_files import load_action

    FIBONACCI = load_action("arduinobot_msgs/action/Fibonacci.action")

The same as a module that type checkers can read is what `fibaction gen` writes.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

from fibaction.action import Action
from fibaction.interfaces.definitions import InterfaceError
from fibaction.interfaces.files import ActionFile, read_action
from fibaction.interfaces.source import python_source
from fibaction.interfaces.structs import make_structs

__all__ = ["InterfaceError", "action_source", "load_action"]


def load_action(
    path: str | os.PathLike[str],
    *,
    name: str = "",
    search: Iterable[str | os.PathLike[str]] = (),
    type_name: str = "",
) -> Action[Any, Any, Any]:
    """Make an action from an `.action` file.

    Its types are structs with the fields, defaults and limits of the file, constants as attributes
    of the class, and comments as descriptions: `action.goal.type(order=3)`.

    `name` is that of the action; without one it is that of the file, `navigate_to_pose` for
    `NavigateToPose.action`. `type_name` is the ROS 2 type; it is known without being given if the
    file lies in `package/action/`.

    Messages that it nests are looked for beside the file, in the packages beside its own, in each
    folder of `search`, and where ROS has its own, if `setup.bash` has been sourced or ROS is in
    this virtual environment. Such a folder holds packages (`package/msg/Type.msg`), is one, or
    holds `.msg` files. The two messages of `builtin_interfaces` need no file.

    Raises:
        InterfaceError: A file is malformed, or a nested message is nowhere; the text names the
            file, the line and what was expected.
        OSError: The file cannot be read.
        ValueError: The name or the type name breaks the rule for such.
    """
    return _made(read_action(path, name=name, type_name=type_name, search=search))


def action_source(
    path: str | os.PathLike[str],
    *,
    name: str = "",
    search: Iterable[str | os.PathLike[str]] = (),
    type_name: str = "",
) -> str:
    """Write the source of a Python module with the types that `load_action` makes, and the action.

    The action is a constant with its name in capitals. The module needs neither the file nor ROS.

    Raises:
        InterfaceError: As for `load_action`, as are all others.
        OSError: The file cannot be read.
        ValueError: The name or the type name breaks the rule for such.
    """
    action = read_action(path, name=name, type_name=type_name, search=search)
    _made(action)  # so that what it cannot be made from is told of now
    return python_source(action)


def _made(action: ActionFile) -> Action[Any, Any, Any]:
    structs = make_structs(action)
    return Action(
        action.name,
        goal=structs[action.goal.class_name],
        feedback=structs[action.feedback.class_name],
        result=structs[action.result.class_name],
        type_name=action.type_name,
    )

"""Actions from ROS 2 interface files, without ROS and without a build step.

    from fibaction.action_files import load_action

    FIBONACCI = load_action("arduinobot_msgs/action/Fibonacci.action")

`fibaction gen` writes the same types as a module, which type checkers can read.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

from fibaction.interfaces import (
    ActionFile,
    InterfaceError,
    make_structs,
    python_source,
    read_action,
)
from fibaction.interfaces.files import define_action, define_types, remember
from fibaction.types.action import Action

__all__ = ["InterfaceError", "action_source", "define_action", "define_types", "load_action"]


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

    `name` is the name of the action; by default it is that of the file, for example
    `navigate_to_pose` for `NavigateToPose.action`. `type_name` is the ROS 2 type; by default it is
    known from the folders if the file lies in `package/action/`.

    Nested messages are searched for next to the file, in the packages next to its own, in each
    folder of `search`, and in the folders of ROS, if `setup.bash` has been sourced or ROS is
    installed in this virtual environment. A folder of `search` holds packages
    (`package/msg/Type.msg`), is a package, or holds `.msg` files. The two messages of
    `builtin_interfaces` need no file.

    Raises:
        InterfaceError: A file is malformed, or a nested message is not found; the text names the
            file, the line and what was expected.
        OSError: The file cannot be read.
        ValueError: The name or the type name is invalid.
    """
    action = read_action(path, name=name, type_name=type_name, search=search)
    made = _made(action)
    remember(action)
    return made


def action_source(
    path: str | os.PathLike[str],
    *,
    name: str = "",
    search: Iterable[str | os.PathLike[str]] = (),
    type_name: str = "",
) -> str:
    """Return the source of a Python module with the types that `load_action` makes, and the action.

    The action is a constant with its name in capitals. The module needs neither the file nor ROS.
    The source has one field per line, however long; run your formatter over it.

    Raises:
        InterfaceError: A file is malformed, or a nested message is not found.
        OSError: The file cannot be read.
        ValueError: The name or the type name is invalid.
    """
    action = read_action(path, name=name, type_name=type_name, search=search)
    _made(action)  # raises now what the module would raise on import
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

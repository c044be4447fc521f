"""The actions that this program has loaded from files or from written modules, by their types."""

from __future__ import annotations

from collections.abc import Mapping

from fibaction.interfaces.files import ActionFile, read_action_texts

_KNOWN: dict[str, ActionFile] = {}
_TEXTS: dict[str, Mapping[str, str]] = {}
"""The texts of the types that are not read yet."""


def remember(action: ActionFile) -> None:
    """Remember a file for transports that need its definitions; of one type the last one counts."""
    if action.type_name:
        _TEXTS.pop(action.type_name, None)
        _KNOWN[action.type_name] = action


def define_action(type_name: str, texts: Mapping[str, str]) -> None:
    """Define a ROS 2 action type for `dds://`, which then needs no file of it.

    Modules that `fibaction gen` has written call it. `texts` are the texts of the `.action` file
    and of the `.msg` files that it nests, by the types that they define, such as
    `geometry_msgs/msg/Pose`. They are read when the type is first used.
    """
    _TEXTS[type_name] = texts


def known_action(type_name: str) -> ActionFile | None:
    """Return the file of a type; None if it was neither loaded nor defined.

    Raises:
        InterfaceError: The texts that define it are malformed.
    """
    if type_name in _TEXTS:
        _KNOWN[type_name] = read_action_texts(type_name, _TEXTS[type_name])
        del _TEXTS[type_name]
    return _KNOWN.get(type_name)

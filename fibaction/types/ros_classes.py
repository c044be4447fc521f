"""Classes of ROS messages, told by what they have, and what a package that knows ROS makes of them.

Nothing of ROS is imported here, and what knows its messages only when there is one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Protocol

from fibaction.words.errors import TransportError

INTERFACES = "fibaction.interfaces"
"""The entry-point group of functions that make message types:

- `ros2` and `ros2_classes` take the name of a ROS 2 type, and return the types of the goal, the
  feedback and the result: structs, and the classes of ROS. They may raise TransportError.
- `ros2_messages` takes a class of ROS, and returns a `MessageClass`.
"""


class MessageClass(Protocol):
    """A class of ROS, as any action uses it."""

    struct: type[Any]
    """A struct with its fields, defaults and constants."""

    @property
    def decode(self) -> Callable[[bytes], Any]:
        """Makes a message of a payload. Raises ProtocolError."""
        ...

    def reader(self, schema: Mapping[str, Any]) -> Callable[[Any], Any]:
        """Return a function that turns a message into plain data that fits this JSON Schema.

        Raises:
            TypeError: The type does not match; the text lists the fields.
        """
        ...


def is_message_class(kind: object) -> bool:
    """Return whether this is a class that ROS has generated."""
    return isinstance(kind, type) and hasattr(kind, "get_fields_and_field_types")


def is_message(value: object) -> bool:
    """Return whether this is a message of ROS."""
    return is_message_class(type(value))


def ros_type_of(kind: object) -> str:
    """Return the ROS 2 type of a class, such as `geometry_msgs/msg/Pose`: of a class of ROS, or of
    a struct that is made from a ROS type. It is empty for any other.
    """
    if isinstance(kind, type) and is_message_class(kind):
        return "/".join((*kind.__module__.split(".")[:2], kind.__name__))
    ros_type: str = getattr(kind, "__ros_type__", "")
    return ros_type


@cache
def message_class(kind: Any) -> MessageClass:
    """Describe a class of ROS.

    Raises:
        TypeError: It has a field that ROS's own Python code cannot handle, or nothing here knows
            ROS's messages.
    """
    try:
        made: MessageClass = load("ros2_messages", ros_type_of(kind))(kind)
    except TransportError as exc:
        raise TypeError(str(exc)) from exc
    return made


def load(name: str, type_name: str) -> Callable[[Any], Any]:
    """Return the function of an entry point; `type_name` is what it is for.

    Raises:
        TransportError: No package declares it, or it cannot be imported.
    """
    from importlib.metadata import entry_points  # slow to import, and needed here only

    found = tuple(entry_points(group=INTERFACES, name=name))
    if not found:
        raise TransportError(
            f"cannot make message types from {type_name!r}: install a package with an entry point"
            f" {name!r} in the group {INTERFACES!r}, such as fibaction itself"
        )
    try:
        loaded: Callable[[Any], Any] = found[0].load()
    except TransportError:
        raise  # its text already says what is missing
    except Exception as exc:  # importing another package may raise anything
        raise TransportError(
            f"cannot make message types from {type_name!r}: {found[0].value} cannot be imported:"
            f" {exc}"
        ) from exc
    return loaded

"""The beginning of a node: its settings, and the arguments of ROS on the command line."""

from __future__ import annotations

import sys
import uuid
from typing import NamedTuple

from fibaction.words.errors import TransportError
from fibaction_transports.ros2.settings import NodeSettings
from fibaction_transports.ros2.without_ros.parameters import USE_SIM_TIME
from fibaction_transports.ros2.without_ros.ros_arguments import (
    NameResolver,
    NodeName,
    RosArguments,
    node_name,
    overrides_of,
    read_arguments,
)

_YES, _NO = ("true", "yes", "on", "y"), ("false", "no", "off", "n")
"""The words of rcl."""


class NodeStart(NamedTuple):
    """The name, the names and the log with which a node begins."""

    name: NodeName
    resolver: NameResolver
    has_rosout: bool
    """True if its log goes to the topic `/rosout`, too."""
    use_sim_time: bool | None
    """The value of this parameter in the arguments; None if they do not have it."""


def node_start(settings: NodeSettings) -> NodeStart:
    """Return what the settings and the arguments say.

    Raises:
        TransportError: ROS does not allow the name, or an argument is not valid.
    """
    given = settings.arguments
    arguments = read_arguments(sys.argv if given is None else given)
    name = settings.name or f"fibaction_{uuid.uuid4().hex[:8]}"
    full = node_name(name, settings.namespace, arguments)
    resolver = NameResolver(full, arguments)
    return NodeStart(full, resolver, arguments.has_rosout, _simulated_time(full, arguments))


def _simulated_time(node: NodeName, arguments: RosArguments) -> bool | None:
    """Return the value of `use_sim_time` in the arguments; None if they do not have it.

    Raises:
        TransportError: It is not a bool.
    """
    given = overrides_of(str(node), arguments.parameters).get(USE_SIM_TIME)
    if given is None:
        return None
    word = str(given.value).lower()
    if word not in _YES + _NO:
        raise TransportError(f"{given.origin}: expected true or false")
    return word in _YES

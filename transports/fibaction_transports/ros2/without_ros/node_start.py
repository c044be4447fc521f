"""The beginning of a node without ROS: its settings, and the arguments on the command line."""

from __future__ import annotations

import sys
import uuid
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

from fibaction_transports.ros2.settings import NodeSettings, RosSettings
from fibaction_transports.ros2.without_ros.ros_arguments import (
    NameResolver,
    NodeName,
    Override,
    node_name,
    overrides_of,
    read_arguments,
)


class OwnNodeSettings(RosSettings, frozen=True, kw_only=True):
    """The settings of a transport of ROS whose nodes need no ROS."""

    scheme: ClassVar[str]
    """The scheme of the transport's URLs."""

    search: Sequence[str] = ()
    """Folders with packages of interface files: `package/action/Type.action` and
    `package/msg/Type.msg`. They are searched before those of `FIBACTION_SEARCH` and those of
    ROS."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: A number is out of range, or a word is not one of those that are valid.
        """
        super().__post_init__()
        if self.introspection != "off":
            raise ValueError(f"introspection needs rclpy: leave it out with {self.scheme}://")


class NodeStart(NamedTuple):
    """The name, the names and the log with which a node begins."""

    name: NodeName
    resolver: NameResolver
    has_rosout: bool
    """True if its log goes to the topic `/rosout`, too."""
    overrides: dict[str, Override]
    """The values of parameters in the arguments."""


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
    overrides = overrides_of(str(full), arguments.parameters)
    return NodeStart(full, resolver, arguments.has_rosout, overrides)

"""`OwnNodeSettings`: the settings of a transport of ROS whose nodes this project makes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from fibaction_transports.ros2.settings import RosSettings


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

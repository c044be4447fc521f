"""The settings of a node, and those of the ends of an action: a server, a client, or both."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec

from fibaction_transports.ros2 import qos

INTROSPECTIONS = ("off", "metadata", "contents")
"""The settings of the introspection of services, as `rclpy.service_introspection` names them."""

LAST_DOMAIN = 232
"""The highest domain ID. Higher ones would have ports above 65535."""


class NodeSettings(msgspec.Struct, frozen=True):
    """Settings of a node that fibaction makes."""

    name: str = ""
    """The name; without one, a unique name is made."""
    namespace: str = ""
    domain_id: int | None = None
    """The domain; None takes it from ROS_DOMAIN_ID in the environment."""
    arguments: Sequence[str] | None = None
    """ROS's arguments, for example `["--ros-args", "-r", "a:=b"]`; None is the command line."""


class EndSettings(msgspec.Struct, frozen=True, kw_only=True):
    """The settings of both ends. `Ros2Transport` describes each of them."""

    feedback_depth: int = 1000
    discovery_timeout: float = 4.0
    lease: float = 2.0
    reconnect: bool = True
    reconnect_timeout: float = 10.0
    services_qos: str = ""
    feedback_qos: str = ""
    status_qos: str = ""
    introspection: str = "off"

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: A number is out of range, or a word is not one of those that are valid.
        """
        check_range("feedback_depth", self.feedback_depth, 1, 100_000)
        check_range("discovery_timeout", self.discovery_timeout, 0, math.inf)
        check_range("lease", self.lease, 0.1, 3600)
        check_range("reconnect_timeout", self.reconnect_timeout, 0, math.inf)
        for name in ("services_qos", "feedback_qos", "status_qos"):
            try:
                qos.policies(getattr(self, name))
            except ValueError as exc:
                raise ValueError(f"invalid {name}: {exc}") from exc
        if self.introspection not in INTROSPECTIONS:
            raise ValueError(
                f"introspection is one of {', '.join(INTROSPECTIONS)}, not {self.introspection!r}"
            )

    @property
    def grace(self) -> float:
        """Seconds for which waiting calls continue after their server has fallen silent."""
        return self.reconnect_timeout if self.reconnect else 0.0


def check_range(name: str, value: float, least: float, most: float) -> None:
    """Check a setting that is a number.

    Raises:
        ValueError: It is out of range.
    """
    if not least <= value <= most:
        raise ValueError(f"{name} must be between {least} and {most}, not {value}")

"""The settings of a node of ROS, and of the actions that it serves and calls."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import msgspec

from fibaction.border.peer_text import excerpt
from fibaction.border.settings import TransportSettings, check_range
from fibaction.words.errors import TransportError
from fibaction_transports.ros2 import qos

INTROSPECTIONS = ("off", "metadata", "contents")
"""The settings of the introspection of services, as `rclpy.service_introspection` names them."""

DOMAIN = "ROS_DOMAIN_ID"
LAST_DOMAIN = 232
"""The highest domain ID. Higher ones would have ports above 65535."""


def domain_in(environ: Mapping[str, str]) -> int:
    """Return the domain that the environment says; 0 if it says none.

    Raises:
        TransportError: It is not one of ROS.
    """
    given = environ.get(DOMAIN) or "0"
    if given.isascii() and given.isdecimal() and int(given) <= LAST_DOMAIN:
        return int(given)
    raise TransportError(
        f"invalid {DOMAIN} in the environment: {excerpt(given)!r} is not a number from 0 to"
        f" {LAST_DOMAIN}"
    )


class NodeSettings(msgspec.Struct, frozen=True):
    """Settings of a node that fibaction makes."""

    name: str = ""
    """The name; without one, a unique name is made."""
    namespace: str = ""
    domain_id: int | None = None
    """The domain; None takes it from ROS_DOMAIN_ID in the environment."""
    arguments: Sequence[str] | None = None
    """ROS's arguments, for example `["--ros-args", "-r", "a:=b"]`; None is the command line."""


class RosSettings(TransportSettings, frozen=True, kw_only=True):
    """The settings of a transport of ROS."""

    only_in_code: ClassVar[tuple[str, ...]] = ("arguments",)
    only_for_clients: ClassVar[tuple[str, ...]] = (
        "discovery_timeout",
        "reconnect",
        "reconnect_timeout",
    )
    shared: ClassVar[tuple[str, ...]] = (
        "namespace",
        "domain_id",
        "lease",
        "services_qos",
        "feedback_qos",
        "status_qos",
    )
    """The settings that a client and its server should have in common."""

    namespace: str = ""
    """The namespace of the node, and of relative names of actions."""
    domain_id: int | None = None
    """The ROS domain; None takes `ROS_DOMAIN_ID` from the environment."""
    arguments: Sequence[str] | None = None
    """ROS's arguments on a command line, for example `["--ros-args", "-r", "fibonacci:=sequence"]`;
    None takes the program's own."""
    feedback_depth: int = 1000
    """The number of feedback messages that are kept. A client keeps so many of each goal until they
    are read; then the oldest is dropped. A server keeps so many of all goals in the middleware, and
    publishes at most five times as many in a second."""
    discovery_timeout: float = 4.0
    """Seconds for which a new client waits if it finds no server. Nodes announce themselves at
    once, and again after 3 s: on a busy machine, discovery may take as long."""
    lease: float = 2.0
    """Seconds, from 0.1 to 3600. A server gives signs of life so often that clients with this
    lease, or a longer one, do not miss it. At a client, a server counts as silent after so many
    seconds without one. A client whose lease is shorter than the server's gets no signs of life."""
    reconnect: bool = True
    """False ends the waiting calls of a client with `ConnectionLost` as soon as their server is
    silent."""
    reconnect_timeout: float = 10.0
    """Seconds that a client waits for a silent server to come back."""
    services_qos: str = ""
    """The quality of service of the three services, as words of ROS with commas: `reliable` or
    `best_effort`, `volatile` or `transient_local`. Words that are left out are those of
    `rcl_action`."""
    feedback_qos: str = ""
    """The same for the feedback topic, for example `best_effort`."""
    status_qos: str = ""
    """The same for the status topic, for example `volatile`."""
    introspection: str = "off"
    """The events that the services publish at each request and answer: `"off"`, `"metadata"` (who,
    and when) or `"contents"`, which has the messages, too. It needs rclpy."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: A number is out of range, or a word is not one of those that are valid.
        """
        check_range("domain_id", self.domain_id or 0, 0, LAST_DOMAIN)
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
                f"introspection must be one of {', '.join(INTROSPECTIONS)},"
                f" not {self.introspection!r}"
            )

    def node_settings(self, name: str | None) -> NodeSettings:
        """Return those of a node of that name; None makes a unique one."""
        return NodeSettings(name or "", self.namespace, self.domain_id, self.arguments)

    @property
    def grace(self) -> float:
        """Seconds for which waiting calls continue after their server has fallen silent."""
        return self.reconnect_timeout if self.reconnect else 0.0


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

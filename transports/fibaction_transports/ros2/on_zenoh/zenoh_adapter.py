"""The way to a graph of ROS over Zenoh."""

from __future__ import annotations

import os
from collections.abc import AsyncGenerator, Sequence
from contextlib import asynccontextmanager
from typing import ClassVar, Literal

from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.words.errors import TransportError
from fibaction_transports.ros2.node.ros_node import RosAdapter
from fibaction_transports.ros2.on_zenoh.config import Configuration
from fibaction_transports.ros2.on_zenoh.node import ZenohNode, open_node
from fibaction_transports.ros2.settings import LAST_DOMAIN, NodeSettings, RosSettings
from fibaction_transports.ros2.without_ros.messages.file_types import FileTypes
from fibaction_transports.ros2.without_ros.node_start import node_start

DOMAIN = "ROS_DOMAIN_ID"

logger = clean_logger("fibaction.ros2")


class ZenohSettings(RosSettings, frozen=True, kw_only=True):
    """The settings of a `ZenohTransport`."""

    shared: ClassVar[tuple[str, ...]] = (*RosSettings.shared, "locators")

    locators: Sequence[str] = ()
    """The routers or peers to connect to, for example `tcp/robot.local:7447`. Without them, those
    of the configuration of ROS, or `tcp/localhost:7447`."""
    mode: Literal["", "peer", "client"] = ""
    """`peer` connects to the nodes that it learns of from a router, and continues when the router
    stops; `client` speaks through the router only, and needs less memory. Without it, that of the
    configuration of ROS, or `peer`."""
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
            raise ValueError("introspection needs rclpy: leave it out with zenoh://")
        if self.mode not in ("", "peer", "client"):
            raise ValueError(f"mode is peer or client, not {self.mode!r}")


class ZenohAdapter(RosAdapter):
    """The way to a graph of ROS over Zenoh."""

    def __init__(self, node: NodeSettings, settings: ZenohSettings) -> None:
        self.types = self._types = FileTypes(settings.search)
        self._node = node
        self._settings = settings

    @asynccontextmanager
    async def open(self) -> AsyncGenerator[ZenohNode, None]:
        """See `RosAdapter.open`."""
        start, settings = node_start(self._node), self._settings
        configuration = Configuration(
            mode=settings.mode, locators=settings.locators, environ=os.environ
        )
        async with open_node(configuration, self._domain(), start, self._types) as node:
            if start.use_sim_time is not None:
                node.parameters.set_use_sim_time(start.use_sim_time)
            yield node

    def _domain(self) -> int:
        if self._node.domain_id is not None:
            return self._node.domain_id
        given = os.environ.get(DOMAIN) or "0"
        if given.isascii() and given.isdecimal() and int(given) <= LAST_DOMAIN:
            return int(given)
        raise TransportError(
            f"invalid {DOMAIN} in the environment: {excerpt(given)!r} is not a number from 0 to"
            f" {LAST_DOMAIN}"
        )

"""The way to a graph of ROS over Zenoh."""

from __future__ import annotations

import os
from collections.abc import AsyncGenerator, Sequence
from contextlib import asynccontextmanager
from typing import ClassVar, Literal

from fibaction_transports.ros2.node.ros_node import RosAdapter
from fibaction_transports.ros2.on_zenoh.config import Configuration
from fibaction_transports.ros2.on_zenoh.node import ZenohNode, open_node
from fibaction_transports.ros2.settings import NodeSettings, OwnNodeSettings, domain_in
from fibaction_transports.ros2.without_ros.messages.file_types import FileTypes
from fibaction_transports.ros2.without_ros.own_node import node_start


class ZenohSettings(OwnNodeSettings, frozen=True, kw_only=True):
    """The settings of a `ZenohTransport`."""

    scheme = "zenoh"
    shared: ClassVar[tuple[str, ...]] = (*OwnNodeSettings.shared, "locators", "type_hashes")

    locators: Sequence[str] = ()
    """The routers or peers to connect to, for example `tcp/robot.local:7447`. Without them, those
    of the configuration of ROS, or `tcp/localhost:7447`."""
    mode: Literal["", "peer", "client"] = ""
    """`peer` connects to the nodes that it learns of from a router, and continues when the router
    stops; `client` speaks through the router only, and needs less memory. Without it, that of the
    configuration of ROS, or `peer`."""
    config: str = ""
    """Values of Zenoh's own configuration, which count before all others, as `key=json5;key=json5`:
    for example `transport/auth/usrpwd/user="me";transport/auth/usrpwd/password="secret"`."""

    type_hashes: bool = True
    """False for the nodes of ROS 2 Humble, which do not tell the versions of types."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: A number is out of range, or a word is not one of those that are valid.
        """
        super().__post_init__()
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
            mode=settings.mode,
            locators=settings.locators,
            environ=os.environ,
            lease=settings.lease,
            values=settings.config,
        )
        given = self._node.domain_id
        domain = domain_in(os.environ) if given is None else given
        hashes = settings.type_hashes
        async with open_node(configuration, domain, start, self._types, hashes) as node:
            yield node

"""The way to a graph of ROS over our own DDS."""

from __future__ import annotations

import os
from collections.abc import AsyncGenerator, Sequence
from contextlib import asynccontextmanager
from typing import ClassVar

from fibaction.border.peer_text import excerpt
from fibaction.border.settings import check_range
from fibaction.words.errors import TransportError
from fibaction_transports.ros2.node.ros_node import RosAdapter
from fibaction_transports.ros2.on_dds.node import DdsNode, open_node
from fibaction_transports.ros2.settings import NodeSettings, OwnNodeSettings
from fibaction_transports.ros2.without_ros.messages.file_types import FileTypes
from fibaction_transports.ros2.without_ros.own_node import node_start
from fibaction_transports.rtps.ports import IP_VERSIONS, DiscoveryRange, DomainSettings

DISCOVERY_SERVER = "ROS_DISCOVERY_SERVER"
"""The variable of Fast DDS for nodes that find each other by a server."""
_USUAL = "default"


class DdsSettings(OwnNodeSettings, frozen=True, kw_only=True):
    """The settings of a `DdsTransport`."""

    scheme = "dds"
    shared: ClassVar[tuple[str, ...]] = (
        *OwnNodeSettings.shared,
        "discovery",
        "peers",
        "ip_versions",
    )

    discovery: str = ""
    """`SUBNET`, `LOCALHOST` or `OFF`: how far other nodes are looked for. Without it,
    `ROS_AUTOMATIC_DISCOVERY_RANGE` says it, and else it is `SUBNET`, as in ROS."""
    peers: Sequence[str] = ()
    """Hosts that are asked in addition, where multicast does not reach; without them, those of
    `ROS_STATIC_PEERS`."""
    network: Sequence[str] = ()
    """The addresses of this machine's interfaces that take part in multicast; by default that of
    the default route."""
    ip_versions: Sequence[int] = ()
    """The versions of IP that are used: `(4,)`, `(6,)` or `(4, 6)`. By default 4, and 6 as well if
    a peer is an address of IPv6."""
    fragment_size: int = 63_000
    """Bytes of a message that go into one datagram, from 256 to 63,000. Where much is lost, a size
    below the MTU loses less."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: A number is out of range, or a word is not one of those that are valid.
        """
        super().__post_init__()
        check_range("fragment_size", self.fragment_size, 256, 63_000)
        if self.discovery and self.discovery not in DiscoveryRange.__members__:
            known = ", ".join(DiscoveryRange.__members__)
            raise ValueError(f"discovery must be one of {known}, not {self.discovery!r}")
        if self.ip_versions and tuple(self.ip_versions) not in IP_VERSIONS:
            given = ",".join(map(str, self.ip_versions))
            raise ValueError(f"ip_versions must be one of 4, 6 and 4,6, not {given}")


class DdsAdapter(RosAdapter):
    """The way to a graph of ROS over our own DDS."""

    def __init__(self, node: NodeSettings, settings: DdsSettings) -> None:
        self.types = self._types = FileTypes(settings.search)
        self._node = node
        self._settings = settings

    @asynccontextmanager
    async def open(self) -> AsyncGenerator[DdsNode, None]:
        """See `RosAdapter.open`."""
        opened = open_node(
            self.domain(),
            node_start(self._node),
            self._types,
            network=self._settings.network,
            fragment_size=self._settings.fragment_size,
        )
        async with opened as node:
            for sentence in self.left_out():
                node.warn(sentence)
            yield node

    def left_out(self) -> list[str]:
        """Return a sentence for each variable of the environment that is not followed here."""
        server = os.environ.get(DISCOVERY_SERVER)
        if not server:
            return []
        sentence = (
            f"{DISCOVERY_SERVER}={excerpt(server)} is not followed: dds:// does not speak to"
            " discovery servers, so nodes that are found only by one are not found here"
        )
        return [sentence]

    def origins(self) -> dict[str, str]:
        """Return where the domain, the range and the static peers come from: a setting, a variable
        of the environment, or the default.
        """
        settings = self._settings
        range_variable = "ROS_AUTOMATIC_DISCOVERY_RANGE"
        if os.environ.get("ROS_LOCALHOST_ONLY") == "1":
            range_variable = "ROS_LOCALHOST_ONLY"
        return {
            name: f"setting {setting}"
            if is_set
            else variable
            if os.environ.get(variable)
            else _USUAL
            for name, setting, is_set, variable in (
                ("domain", "domain_id", self._node.domain_id is not None, "ROS_DOMAIN_ID"),
                ("range", "discovery", settings.discovery, range_variable),
                ("peers", "peers", settings.peers, "ROS_STATIC_PEERS"),
            )
        }

    def domain(self) -> DomainSettings:
        """Return the domain by the settings and the environment.

        Raises:
            TransportError: A variable of the environment has a value that ROS does not know.
        """
        settings, domain = self._settings, self._node.domain_id
        environ = dict(os.environ)
        if domain is not None:
            environ["ROS_DOMAIN_ID"] = str(domain)
        if settings.discovery:
            environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = settings.discovery
            environ.pop("ROS_LOCALHOST_ONLY", None)
        if settings.peers:
            environ["ROS_STATIC_PEERS"] = ";".join(settings.peers)
        try:
            return DomainSettings.from_environment(environ, tuple(settings.ip_versions))
        except ValueError as exc:
            raise TransportError(str(exc)) from exc

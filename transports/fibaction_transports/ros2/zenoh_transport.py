"""`zenoh://host:port/node_name`: actions of ROS 2 over Zenoh where no ROS is installed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Unpack
from urllib.parse import SplitResult

from fibaction.border.settings import TransportSettings
from fibaction.words.extras import NeedsExtra
from fibaction_transports.ros2.messaging.node import NodeTransport
from fibaction_transports.ros2.node.middlewares import ROUTER_PORT

with NeedsExtra("zenoh://", "fibaction[zenoh]"):
    from fibaction_transports.ros2.on_zenoh.node import ZenohAdapter, ZenohSettings

if TYPE_CHECKING:
    from fibaction_transports.keywords import ZenohKeywords


class ZenohTransport(NodeTransport):
    """The actions of a ROS graph whose nodes run on `rmw_zenoh_cpp`."""

    settings_type: ClassVar[type[TransportSettings]] = ZenohSettings
    scheme = "zenoh"
    is_on_zenoh = True

    def __init__(
        self,
        node_name: str | None = None,
        **settings: Unpack[ZenohKeywords],
    ) -> None:
        """Describe the node; nothing is made yet. Each `serve` and `connect` makes its own.

        Args:
            node_name: The name of the node; None makes a unique name.
            settings: See the table of settings.

        Raises:
            ValueError: A number is out of range, or a word is not valid.
        """
        made = ZenohSettings.of(self, settings)
        super().__init__(ZenohAdapter(made.node_settings(node_name), made), made)

    @classmethod
    def address_of(cls, parts: SplitResult) -> dict[str, Any]:
        """Return the router, and the name of the node, in a URL.

        Raises:
            ValueError: The port is not a number, or the path has several names.
        """
        host, port, name = parts.hostname, parts.port, parts.path.strip("/")
        if "/" in name:
            raise ValueError(
                "its path has several names; a URL of ROS over Zenoh is, for example,"
                f" {cls.scheme}://robot.local:7447/node_name?namespace=/robot1"
            )
        address: dict[str, Any] = {"node_name": name or None}
        if host:
            host = f"[{host}]" if ":" in host else host
            address["locators"] = (f"tcp/{host}:{ROUTER_PORT if port is None else port}",)
        return address

    def _hosts(self) -> list[str]:
        return []  # the session says which routers there are

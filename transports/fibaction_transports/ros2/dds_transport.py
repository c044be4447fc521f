"""`dds://node_name`: actions of ROS 2 where no ROS is installed."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Unpack

from fibaction.border.abc import Diagnosis
from fibaction.border.settings import TransportSettings
from fibaction_transports.ros2.messaging.node import NodeTransport
from fibaction_transports.ros2.node.middlewares import middlewares_at
from fibaction_transports.ros2.on_dds.node import DdsAdapter, DdsSettings

if TYPE_CHECKING:
    from fibaction_transports.keywords import DdsKeywords


class DdsTransport(NodeTransport):
    """The actions of a ROS graph, over our own DDS."""

    settings_type: ClassVar[type[TransportSettings]] = DdsSettings
    scheme = "dds"

    def __init__(
        self,
        node_name: str | None = None,
        **settings: Unpack[DdsKeywords],
    ) -> None:
        """Describe the node; nothing is made yet. Each `serve` and `connect` makes its own.

        Args:
            node_name: The name of the node; None makes a unique name.
            settings: See the table of settings.

        Raises:
            ValueError: A number is out of range, or a word is not valid.
        """
        made = DdsSettings.of(self, settings)
        self._dds = DdsAdapter(made.node_settings(node_name), made)
        super().__init__(self._dds, made)

    async def diagnose(self, seconds: float, action: str = "") -> Diagnosis:
        """See `Transport.diagnose`."""
        from fibaction_transports.ros2.on_dds.diagnosis import diagnose_domain  # needed here only

        there = await middlewares_at(self._hosts())
        return await diagnose_domain(self._dds, self._settings, there, seconds, action)

    def _hosts(self) -> list[str]:
        return [*super()._hosts(), *self._dds.domain().static_peers]

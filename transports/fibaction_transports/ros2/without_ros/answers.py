"""Services of a node whose answers need no time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fibaction.border.peer_text import clean_logger
from fibaction_transports.ros2.node.ros_node import RosNode
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.without_ros.messages.message_type import ServiceType

_SERVICES = EndQos(depth=1000)

logger = clean_logger("fibaction.ros2")


def provide(
    ros: RosNode, service: str, service_type: ServiceType, answer: Callable[[Any], Any]
) -> None:
    """Serve a service of a node whose answers need no time.

    Raises:
        TransportError: The service cannot be made.
    """

    def take(header: Any, request: Any) -> None:
        if not provider.answer(header, answer(request)):
            logger.info("%s: an answer cannot reach its client, and is lost", service)

    provider = ros.provider(service, service_type, _SERVICES, take)

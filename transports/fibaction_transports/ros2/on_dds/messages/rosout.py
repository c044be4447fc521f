"""The log of a node on the topic `/rosout`, where `ros2 topic echo /rosout`, rqt and Foxglove read
it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from msgspec import Struct, field

from fibaction_transports.cdr.standard_messages import TimeMessage
from fibaction_transports.ros2.on_dds.messages.node_messages import node_message
from fibaction_transports.rtps.qos import Durability, Qos

ROSOUT: Final = "/rosout"
ROSOUT_QOS: Final = Qos(durability=Durability.TRANSIENT_LOCAL, depth=1000, lifespan=10.0)
"""The QoS of ROS: a node that comes late reads the lines of the last ten seconds."""
_BILLION = 10**9


class LogMessage(Struct):
    """An `rcl_interfaces/msg/Log`."""

    stamp: TimeMessage = field(default_factory=TimeMessage)
    level: int = 0
    """The level, which has the number of the same level in `logging`."""
    name: str = ""
    msg: str = ""
    file: str = ""
    function: str = ""
    line: int = 0


LOG: Final = node_message(
    "rcl_interfaces/msg/Log",
    "Time stamp\nuint8 level\nstring name\nstring msg\nstring file\nstring function\nuint32 line",
    LogMessage,
)


class RosoutLog:
    """The log of one node, for other nodes."""

    def __init__(self, full_name: str, publish: Callable[[LogMessage], None]) -> None:
        self._logger = full_name.removeprefix("/").replace("/", ".")
        self._publish = publish

    def write(self, level: int, text: str) -> None:
        """Publish a line."""
        stamp = TimeMessage(*divmod(time.time_ns(), _BILLION))
        self._publish(LogMessage(stamp, level, self._logger, text))

"""The types of messages, as ends of topics and services need them."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

from fibaction.interfaces.files import InterfaceMessage
from fibaction_transports.cdr.codec import CdrCodec
from fibaction_transports.cdr.type_hashes import type_hash
from fibaction_transports.ros2.on_dds.names import dds_type


class MessageType:
    """A type of messages. Called, it makes one with its defaults, but for the fields given."""

    def __init__(
        self, definition: InterfaceMessage, codec: CdrCodec, make: Callable[..., Any]
    ) -> None:
        self.name = definition.type_name
        """The name in ROS, for example `std_msgs/msg/String`."""
        self.codec = codec
        self._definition = definition
        self._make = make

    def __call__(self, **fields: Any) -> Any:
        return self._make(**fields)

    @cached_property
    def dds_name(self) -> str:
        """The name in DDS."""
        return dds_type(self.name)

    @cached_property
    def user_data(self) -> bytes:
        """The user data that an endpoint of this type announces: the hash of the type."""
        return f"typehash={type_hash(self._definition)};".encode()


class ServiceType:
    """A type of services."""

    def __init__(self, request: MessageType, response: MessageType) -> None:
        self.Request = request
        self.Response = response

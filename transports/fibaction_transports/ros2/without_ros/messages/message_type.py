"""The types of messages, as ends of topics and services need them, and the names that ROS gives to
types in DDS and Zenoh.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cached_property
from typing import Any, Final, NamedTuple

from fibaction.interfaces.files import InterfaceMessage
from fibaction_transports.cdr.codec import CdrCodec
from fibaction_transports.cdr.standard_messages import service_interface
from fibaction_transports.cdr.type_hashes import PREFIX, type_hash


def dds_type(type_name: str) -> str:
    """Return the name in DDS of a type of ROS: `std_msgs::msg::dds_::String_` for
    `std_msgs/msg/String`.
    """
    package, folder, name = type_name.split("/")
    return f"{package}::{folder}::dds_::{name}_"


def ros_type(name: str) -> str:
    """Return the name in ROS of a type of DDS; the name itself if ROS has not made it."""
    package, *rest = name.split("::")
    if len(rest) == 3 and rest[1] == "dds_" and rest[2].endswith("_"):
        return "/".join((package, rest[0], rest[2][:-1]))
    return name


_TYPE_HASH: Final = "typehash"
_ACTION_HASH: Final = "actionhash"
_ITEMS = re.compile(rf"({_TYPE_HASH}|{_ACTION_HASH})=({PREFIX}[0-9a-f]{{64}});")
_REQUEST = "_Request"


class TypeHashes(NamedTuple):
    """The hashes that an endpoint announces; empty if it announces none."""

    of_type: str = ""
    of_action: str = ""
    """That of the action whose feedback it has; only our own endpoints announce it."""


def read_hashes(user_data: bytes) -> TypeHashes:
    """Return the hashes in the user data of an endpoint."""
    found = dict(_ITEMS.findall(user_data.decode("latin-1")))
    return TypeHashes(found.get(_TYPE_HASH, ""), found.get(_ACTION_HASH, ""))


class MessageType:
    """A type of messages. Called, it makes one with its defaults, but for the fields given."""

    def __init__(
        self,
        definition: InterfaceMessage,
        codec: CdrCodec,
        make: Callable[..., Any],
        *,
        action: InterfaceMessage | None = None,
        is_known: bool = True,
    ) -> None:
        """Describe a type.

        Args:
            definition: Its fields.
            codec: The codec of its messages.
            make: Makes a message with its defaults.
            action: The type of the action whose feedback these messages have.
            is_known: False if the definition is not the whole one, so that it is not announced.
        """
        self.name = definition.type_name
        """The name in ROS, for example `std_msgs/msg/String`."""
        self.codec = codec
        self.definition = definition
        self.action = action
        self.is_known = is_known
        self._make = make

    def __call__(self, **fields: Any) -> Any:
        return self._make(**fields)

    @cached_property
    def dds_name(self) -> str:
        """The name in DDS."""
        return dds_type(self.name)

    @cached_property
    def type_hash(self) -> str:
        """The hash of the definition."""
        return type_hash(self.definition)

    @cached_property
    def user_data(self) -> bytes:
        """The announcement of an endpoint: the hash of the type, and that of the action."""
        items = [(_TYPE_HASH, self.type_hash)] if self.is_known else []
        if self.action is not None:
            items.append((_ACTION_HASH, type_hash(self.action)))
        return "".join(f"{name}={value};" for name, value in items).encode()


class ServiceType:
    """A type of services."""

    def __init__(self, request: MessageType, response: MessageType) -> None:
        self.Request = request
        self.Response = response

    @property
    def name(self) -> str:
        """The name in ROS, for example `std_srvs/srv/Trigger`."""
        return self.Request.name.removesuffix(_REQUEST)

    @property
    def is_known(self) -> bool:
        """False if a definition is not the whole one."""
        return self.Request.is_known and self.Response.is_known

    @property
    def definition(self) -> InterfaceMessage:
        """The definition of the service."""
        return service_interface(self.name, self.Request.definition, self.Response.definition)

    @cached_property
    def type_hash(self) -> str:
        """The hash of the definition."""
        return type_hash(self.definition)

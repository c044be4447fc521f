"""The types of topics and services without ROS."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from fibaction.interfaces.files import InterfaceMessage, ServiceFile, inside_out
from fibaction.interfaces.structs import structs_of
from fibaction_transports.cdr.codec import CdrCodec
from fibaction_transports.ros2.node.ros_node import CalledType, TopicType
from fibaction_transports.ros2.without_ros.messages.action_types import message_kind
from fibaction_transports.ros2.without_ros.messages.message_type import MessageType, ServiceType


def topic_type_of(message: InterfaceMessage) -> TopicType:
    """Return the type of a topic whose messages have this definition."""
    structs = structs_of(inside_out(message))
    return TopicType(_type_of(message, structs), message_kind(message, structs))


def called_type_of(file: ServiceFile) -> CalledType:
    """Return the type of a service with this definition."""
    structs = structs_of(inside_out(file.request, file.response))
    service = ServiceType(_type_of(file.request, structs), _type_of(file.response, structs))
    request, response = (message_kind(part, structs) for part in file)
    return CalledType(service, request, response)


def _type_of(message: InterfaceMessage, structs: Mapping[str, type[msgspec.Struct]]) -> MessageType:
    codec = CdrCodec(message, structs, as_arrays=True)
    return MessageType(message, codec, structs[message.class_name])

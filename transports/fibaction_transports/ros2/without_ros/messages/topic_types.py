"""The types of topics and services without ROS."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import msgspec

from fibaction.interfaces.files import InterfaceMessage, ServiceFile, inside_out
from fibaction.interfaces.structs import structs_of
from fibaction_transports.cdr.codec import CdrCodec
from fibaction_transports.ros2.node.ros_node import CalledType, TopicType
from fibaction_transports.ros2.without_ros.messages.action_types import message_kind
from fibaction_transports.ros2.without_ros.messages.message_type import MessageType, ServiceType
from fibaction_transports.ros2.without_ros.messages.node_messages import (
    NODE_STRUCTS,
    PARAMETER_EVENT,
)
from fibaction_transports.ros2.without_ros.messages.parameter_messages import PARAMETER_SERVICES


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


@cache
def known_topic_types() -> dict[str, TopicType]:
    """Return the types of topics that every node has, which need no files."""
    kind = message_kind(PARAMETER_EVENT.definition, NODE_STRUCTS)
    return {PARAMETER_EVENT.name: TopicType(PARAMETER_EVENT, kind)}


@cache
def known_called_types() -> dict[str, CalledType]:
    """Return the types of services that every node has, which need no files."""
    return {
        one.name: CalledType(
            one,
            message_kind(one.Request.definition, NODE_STRUCTS),
            message_kind(one.Response.definition, NODE_STRUCTS),
        )
        for one in PARAMETER_SERVICES
    }


def _type_of(message: InterfaceMessage, structs: Mapping[str, type[msgspec.Struct]]) -> MessageType:
    codec = CdrCodec(message, structs, as_arrays=True)
    return MessageType(message, codec, structs[message.class_name])

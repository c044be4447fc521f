"""The types that a node uses, which it describes to other nodes.

A type is asked for by its hash, as endpoints announce it. Like nodes of rclpy, a node describes its
topics' messages, its services and its actions as a whole.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Final

from fibaction.interfaces.files import InterfaceMessage
from fibaction_transports.cdr.type_hashes import PREFIX, Description, type_description, type_hash
from fibaction_transports.ros2.without_ros.descriptions import described_types as messages
from fibaction_transports.ros2.without_ros.messages.message_type import MessageType, ServiceType

NOT_USED: Final = "Type not currently in use by this node"
NOT_A_HASH: Final = "Failed to parse type hash"
"""The words of rclpy."""
_HASH = re.compile(rf"{PREFIX}[0-9a-f]{{64}}")
_ACTION_PARTS = ("goal", "result", "feedback")
_IMPLICIT, _ACTION, _MESSAGE = "implicit", "action", "msg"


class TypeRegistry:
    """The types that a node uses, by their hashes."""

    def __init__(self) -> None:
        self._new: list[InterfaceMessage] = []
        """The types whose hashes are not yet needed."""
        self._seen: set[str] = set()
        self._by_hash: dict[str, InterfaceMessage] = {}

    def add_messages(self, message_type: MessageType) -> None:
        """Add the type of an endpoint, and its action if it has one."""
        if message_type.is_known:
            self._add(message_type.definition)
        if message_type.action is not None:
            self._add(message_type.action)
            for part in ("send_goal_service", "get_result_service"):
                self._add(message_type.action.nested[part])

    def add_service(self, service_type: ServiceType) -> None:
        """Add the type of a service."""
        if service_type.is_known:
            self._add(service_type.definition)

    def _add(self, definition: InterfaceMessage) -> None:
        if definition.type_name not in self._seen:
            self._seen.add(definition.type_name)
            self._new.append(definition)

    def answer(self, request: messages.DescriptionRequest) -> messages.DescriptionResponse:
        """Describe a type."""
        if not _HASH.fullmatch(request.type_hash):
            return messages.DescriptionResponse(failure_reason=NOT_A_HASH)
        self._by_hash |= {type_hash(one): one for one in self._new}
        self._new.clear()
        found = self._by_hash.get(request.type_hash)
        if found is None:
            return messages.DescriptionResponse(failure_reason=NOT_USED)
        sources = list(_sources(found)) if request.include_type_sources else []
        return messages.DescriptionResponse(
            successful=True, type_description=_described(found), type_sources=sources
        )


def _described(definition: InterfaceMessage) -> messages.TypeDescription:
    whole = type_description(definition)
    return messages.TypeDescription(
        _individual(whole["type_description"]),
        [_individual(one) for one in whole["referenced_type_descriptions"]],
    )


def _individual(description: Description) -> messages.IndividualTypeDescription:
    fields = [
        messages.FieldDescription(
            field["name"],
            messages.FieldTypeDescription(**field["type"]),
        )
        for field in description["fields"]
    ]
    return messages.IndividualTypeDescription(description["type_name"], fields)


def _sources(definition: InterfaceMessage) -> Iterator[messages.TypeSource]:
    """Yield the texts of a type, and of all that it nests."""
    seen: set[str] = set()
    left = [definition]
    while left:
        one = left.pop()
        if one.type_name in seen:
            continue
        seen.add(one.type_name)
        left.extend(one.nested.values())
        yield messages.TypeSource(one.type_name, *_text(one))


def _text(definition: InterfaceMessage) -> tuple[str, str]:
    """Return the encoding of a text, and the text. What ROS makes of files by itself has none."""
    folder = definition.type_name.split("/")[1]
    if folder == _ACTION and set(_ACTION_PARTS) <= definition.nested.keys():
        parts = (definition.nested[part].definition.text for part in _ACTION_PARTS)
        return _ACTION, "---\n".join(parts)
    if folder == _MESSAGE and definition.definition.text:
        return _MESSAGE, definition.definition.text
    return _IMPLICIT, ""

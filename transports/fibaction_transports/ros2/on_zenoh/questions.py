"""The questions of a node about the types of actions: a server describes its services by hash."""

from __future__ import annotations

from collections.abc import Sequence

from fibaction_transports.ros2.node.parts import EndInfo
from fibaction_transports.ros2.node.ros_node import RosNode
from fibaction_transports.ros2.without_ros.descriptions.description_messages import (
    DescriptionRequest,
    IndividualTypeDescription,
    UnusableDescription,
)
from fibaction_transports.ros2.without_ros.descriptions.type_learner import (
    ActionQuestions,
    ask_node,
)

_PARTS = ("_SendGoal", "_GetResult", "_FeedbackMessage")


class ServiceQuestions(ActionQuestions):
    """The questions about both services of an action, and about its feedback.

    Tokens announce the hashes of services, of which rclpy tells all types: so goals and results.
    """

    def __init__(self, node: RosNode) -> None:
        self._node = node

    def can_ask(self, ends: Sequence[EndInfo]) -> bool:
        return all(one.type_hash for one in ends)

    async def look_up(
        self, ends: Sequence[EndInfo], type_name: str
    ) -> dict[str, IndividualTypeDescription]:
        found: dict[str, IndividualTypeDescription] = {}
        for part, end in zip(_PARTS, ends, strict=True):
            request = DescriptionRequest(type_name + part, end.type_hash)
            response = await ask_node(self._node, end.node, request)
            if not response.successful:
                raise UnusableDescription(response.failure_reason)
            whole = response.type_description
            described = (whole.type_description, *whole.referenced_type_descriptions)
            found |= {one.type_name: one for one in described}
        return found

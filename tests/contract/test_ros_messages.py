"""ROS messages as goal, feedback and result, by classes that are like those of ROS."""

from __future__ import annotations

import array
from collections.abc import AsyncIterator
from typing import Any

import pytest

from fibaction import Action, ActionServer, GoalHandle
from fibaction.testing.contract.reach import Reach
from tests.support.fibonacci import FIBONACCI
from tests.support.ros_classes import Point, ros_class

pytestmark = pytest.mark.anyio

# What can be imported under these names is ROS's own, where the contract is run over ROS.
Goal, Feedback, Result = (
    ros_class(f"{FIBONACCI.type_name}_{part}", fields, is_found=False)
    for part, fields in (
        ("Goal", {"order": "int32"}),
        ("Feedback", {"partial_sequence": "sequence<int32>"}),
        ("Result", {"sequence": "sequence<int32>"}),
    )
)
OF_ROS: Action[Any, Any, Any] = Action(
    "fibonacci", goal=Goal, feedback=Feedback, result=Result, type_name=FIBONACCI.type_name
)


async def fibonacci(goal: GoalHandle[Any]) -> AsyncIterator[Any]:
    numbers = array.array("i", [0] * goal.request.order)
    yield Feedback(partial_sequence=numbers)
    yield Result(sequence=numbers)


@pytest.mark.promise("ACCEPT-17")
@pytest.mark.parametrize("action", [FIBONACCI, OF_ROS], ids=["structs", "classes"])
async def test_messages_are_taken_wherever_structs_are(
    reach: Reach, action: Action[Any, Any, Any]
) -> None:
    feedback: list[Any] = []
    async with reach(ActionServer(action, fibonacci)) as client:
        result = await client.call(Goal(order=3), on_feedback=feedback.append)

    assert [list(one.partial_sequence) for one in feedback] == [[0, 0, 0]]
    assert list(result.sequence) == [0, 0, 0]
    assert (type(feedback[0]), type(result)) == (action.feedback.type, action.result.type)


@pytest.mark.promise("ACCEPT-17")
async def test_a_message_of_another_type_is_an_error_and_not_sent(reach: Reach) -> None:
    async with reach(ActionServer(FIBONACCI, fibonacci)) as client:
        with pytest.raises(TypeError) as caught:
            await client.call(Point())
        assert await client.goals() == []

    assert str(caught.value) == (
        f"Expected `{FIBONACCI.type_name}_Goal`, got `like_msgs/msg/Point`"
    )

"""ROS messages that an executor yields, keeps, or gives as a part of a result."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Any

import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalAborted,
    GoalHandle,
    GoalStatus,
    Return,
)
from fibaction.ros_types import from_ros
from tests.support.ros_classes import Dock_Feedback, Dock_Goal, Dock_Result, Point, Vector3

pytestmark = pytest.mark.anyio

OurFeedback: Any = type(from_ros(Dock_Feedback()))
OurResult: Any = type(from_ros(Dock_Result()))
DOCK: Action[Any, Any, Any] = Action(
    "dock",
    goal=Dock_Goal,
    feedback=OurFeedback,
    result=OurResult,
    type_name="like_msgs/action/Dock",
)
LIKE: Action[Any, Any, Any] = Action(
    "like", goal=Dock_Goal, feedback=dict, result=type(from_ros(Point()))
)


async def outcome_of(action: Action[Any, Any, Any], *items: Any) -> tuple[list[Any], Any]:
    """Return the feedback and the outcome of a goal whose executor yields these, or raises one."""

    async def executor(goal: GoalHandle[Any]) -> AsyncIterator[Any]:
        for item in items:
            if isinstance(item, BaseException):
                raise item
            yield item

    async with ActionServer(action, executor) as server:
        goal = await ActionClient(server, action).send_goal(Dock_Goal())
        return [item async for item in goal], await goal.outcome()


async def test_a_message_is_feedback_or_the_result_by_its_type() -> None:
    # The two have the same fields.
    feedback, outcome = await outcome_of(
        DOCK, Dock_Feedback(distance=1.0), OurFeedback(distance=2.0), Dock_Result(distance=3.0)
    )
    assert feedback == [OurFeedback(distance=1.0), OurFeedback(distance=2.0)]
    assert outcome.result == OurResult(distance=3.0)


async def test_a_message_that_is_of_neither_type_is_a_mistake() -> None:
    _, outcome = await outcome_of(DOCK, Point())
    assert (outcome.status, outcome.reason) == (
        GoalStatus.ABORTED,
        (
            "the executor is wrong: it yielded the ROS message like_msgs/msg/Point, which is"
            " neither feedback (Dock_Feedback) nor a result (Dock_Result)"
        ),
    )


async def test_a_message_that_could_be_of_both_types_is_a_mistake() -> None:
    _, outcome = await outcome_of(LIKE, Point())
    assert outcome.reason == (
        "the executor is wrong: it yielded the ROS message like_msgs/msg/Point, which could be"
        " feedback or a result: mark the result with `Return(...)`"
    )


async def test_a_marked_message_is_the_result() -> None:
    _, outcome = await outcome_of(LIKE, Return(Point(x=2.0)))
    assert outcome.status is GoalStatus.SUCCEEDED


async def test_a_message_is_a_part_of_the_result() -> None:
    _, outcome = await outcome_of(DOCK, GoalAborted("stuck", result=Dock_Result(distance=1.0)))
    assert (outcome.reason, outcome.result) == ("stuck", OurResult(distance=1.0))
    _, outcome = await outcome_of(DOCK, GoalAborted("stuck", result=Vector3()))
    assert outcome.reason == (
        "stuck (its result is left out: the ROS message like_msgs/msg/Vector3 is not Dock_Result)"
    )

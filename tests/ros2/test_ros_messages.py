"""Messages of ROS itself as goals, feedback and results, over ROS and elsewhere."""

from __future__ import annotations

import array
from collections.abc import AsyncIterator, Callable
from importlib import import_module
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import Action, ActionServer, GoalHandle, TransportError, connect, serve
from fibaction.ros_types import from_ros, to_ros
from fibaction.types.action import Codec
from fibaction_transports import ros2
from fibaction_transports.ros2 import message_structs
from fibaction_transports.ros2.message_structs import message_classes
from tests.ros2.ends import new_url
from tests.support.processes import PATIENCE

numpy: Any = import_module("numpy")
geometry: Any = import_module("geometry_msgs.msg")
Everything: Any = import_module("fibaction_test_msgs.action").Everything
Fibonacci: Any = import_module("arduinobot_msgs.action").Fibonacci
PoseStamped, Pose, Point = geometry.PoseStamped, geometry.Pose, geometry.Point

_LIST: Any = list  # its element type is known at run time only

pytestmark = pytest.mark.asyncio

FIBONACCI: Action[Any, Any, Any] = Action.from_ros(
    "arduinobot_msgs/action/Fibonacci", name="fibonacci", classes="ros"
)
STRUCTS: Action[Any, Any, Any] = Action.from_ros(
    "arduinobot_msgs/action/Fibonacci", name="fibonacci"
)


async def fibonacci(goal: GoalHandle[Any]) -> AsyncIterator[Any]:
    numbers = array.array("i", [0, 1])
    while len(numbers) <= goal.request.order:
        numbers.append(numbers[-1] + numbers[-2])
        yield Fibonacci.Feedback(partial_sequence=numbers)
    yield Fibonacci.Result(sequence=numbers)


@pytest.mark.promise("ACCEPT-17")
@pytest.mark.parametrize("action", [FIBONACCI, STRUCTS], ids=["classes", "structs"])
@pytest.mark.parametrize("url", [new_url, lambda: "tcp://127.0.0.1:0", lambda: "inproc://a"])
async def test_messages_are_taken_wherever_structs_are(
    action: Action[Any, Any, Any], url: Callable[[], str]
) -> None:
    feedback: list[Any] = []
    with anyio.fail_after(PATIENCE):
        async with serve(ActionServer(action, fibonacci), url()) as (there,):
            async with connect(there, action) as client:
                await client.wait_for_server()
                goal = Fibonacci.Goal(order=3)
                result = await client.call(goal, on_feedback=feedback.append)

    assert (type(feedback[0]), type(result)) == (action.feedback.type, action.result.type)
    assert list(feedback[0].partial_sequence) == [0, 1, 1]
    assert list(result.sequence) == [0, 1, 1, 2]


async def test_classes_of_ros_are_those_of_its_package() -> None:
    expected = (Fibonacci.Goal, Fibonacci.Feedback, Fibonacci.Result)
    assert message_classes("arduinobot_msgs/action/Fibonacci") == expected
    assert FIBONACCI.goal.type is Fibonacci.Goal


async def test_classes_of_ros_need_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(message_structs, "find_spec", lambda name: None)
    with pytest.raises(
        TransportError,
        match=r"^the classes of a_msgs/action/A are made by ROS, which is not found here: source",
    ):
        message_classes("a_msgs/action/A")


Dock: Any = msgspec.defstruct("Dock", [("target", PoseStamped), ("path", _LIST[Point])])


async def test_a_message_of_a_subscription_is_a_goal_within_our_types() -> None:
    message = PoseStamped()
    message.header.frame_id, message.pose.position.x = "map", 1.5
    action: Action[Any, Any, Any] = Action("dock", goal=Dock, feedback=Point, result=Pose)

    async def dock(goal: GoalHandle[Any]) -> AsyncIterator[Any]:
        yield goal.request.path[0]
        yield goal.request.target.pose

    feedback: list[Any] = []
    with anyio.fail_after(PATIENCE):
        async with serve(ActionServer(action, dock), "tcp://127.0.0.1:0") as (url,):
            async with connect(url, action) as client:
                goal = Dock(message, [Point(x=2.5)])
                result = await client.call(goal, on_feedback=feedback.append)
    assert (result, feedback) == (message.pose, [Point(x=2.5)])


async def test_messages_become_structs_and_structs_messages() -> None:
    message = PoseStamped()
    message.header.frame_id, message.pose.position.x = "map", 1.5
    value = from_ros(message)
    assert repr(type(value)) == "<class 'fibaction.ros_types.geometry_msgs.msg.PoseStamped'>"
    assert (value.pose.position.x, value.pose.orientation.w) == (1.5, 1.0)
    assert to_ros(value) == message
    goal = to_ros(STRUCTS.goal.type(order=3))
    assert (type(goal), goal.order) == (Fibonacci.Goal, 3)


async def test_arrays_of_numpy_become_those_of_ros() -> None:
    covariance = geometry.PoseWithCovariance()
    covariance.covariance = numpy.arange(36.0)
    value = from_ros(covariance)
    value.covariance = numpy.arange(36.0)
    assert (to_ros(value).covariance == covariance.covariance).all()
    result = from_ros(Everything.Result())
    result.float64s = numpy.full(1000, 0.5)
    assert to_ros(result).float64s == array.array("d", [0.5] * 1000)


@pytest.mark.promise("ACCEPT-17")
async def test_a_message_of_another_type_is_an_error_that_names_both() -> None:
    with pytest.raises(TypeError) as caught:
        STRUCTS.goal.encode(PoseStamped())
    assert str(caught.value) == (
        "Expected `arduinobot_msgs/action/Fibonacci_Goal`, got `geometry_msgs/msg/PoseStamped`"
    )


@pytest.mark.parametrize("part", ["Goal", "Feedback", "Result"])
async def test_every_kind_of_field_comes_back_as_it_was(part: str) -> None:
    message = getattr(Everything, part)()
    assert to_ros(from_ros(message)) == message


async def test_a_type_with_other_fields_is_an_error_that_names_them() -> None:
    with pytest.raises(TypeError, match=r"^Expected `Other`, got `geometry_msgs/msg/Point`: \$\.y"):
        Codec(msgspec.defstruct("Other", [("x", float)])).encode(Point())


async def test_the_package_of_ros_has_its_transports_and_its_nodes_alone() -> None:
    transports = {"DdsTransport", "Ros2Transport", "ZenohTransport"}
    ends = {"Publisher", "Subscription", "OwnParameters", "RemoteParameters"}
    nodes = {"Node", *ends, "EndQos", "Service", "Transform", "open_node", "topic_values"}
    assert transports | nodes == set(ros2.__all__)
    assert all(hasattr(ros2, name) for name in ros2.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'RclpyTransport'"):
        _ = ros2.RclpyTransport

"""What the tools of ROS ask of a node of fibaction's own: parameters, and events of services."""

from __future__ import annotations

from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Any

import anyio
import pytest
from arduinobot_msgs.action import Fibonacci
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient

from fibaction import ActionServer, TransportError, connect, serve
from fibaction_transports.ros2.on_dds.node import DdsAdapter, DdsNode, DdsSettings
from fibaction_transports.ros2.on_rclpy.rclpy_adapter import own_node
from fibaction_transports.ros2.settings import NodeSettings
from tests.ros2.ends import new_url
from tests.ros2.spun import spun_node
from tests.ros2.stock.waiting import eventually
from tests.support.fibonacci import FIBONACCI, Goal, fibonacci
from tests.support.processes import PATIENCE

pytestmark = pytest.mark.anyio


def over_dds(settings: NodeSettings) -> AbstractAsyncContextManager[DdsNode]:
    return DdsAdapter(settings, DdsSettings()).open()


async def answered(future: Any) -> Any:
    async def done() -> bool:
        return bool(future.done())

    await eventually(done, bool)
    return future.result()


async def test_parameters_of_a_node_can_be_listed_read_and_set_while_it_serves() -> None:
    url = new_url()
    place = url.partition("=")[2]
    with anyio.fail_after(PATIENCE), spun_node(place) as node:
        parameters = AsyncParameterClient(node, f"{place}/robot")
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), url.replace("//", "//robot")),
            connect(url, FIBONACCI) as client,
        ):

            async def are_there() -> bool:
                return bool(parameters.services_are_ready())

            await eventually(are_there, bool)
            listed = await answered(parameters.list_parameters())
            assert "use_sim_time" in listed.result.names
            (read,) = (await answered(parameters.get_parameters(["use_sim_time"]))).values
            assert read.bool_value is False
            (set_,) = (
                await answered(parameters.set_parameters([Parameter("use_sim_time", value=True)]))
            ).results
            assert set_.successful
            (goal, other) = [await client.send_goal(Goal(1)) for _ in range(2)]
            assert goal.stamp == other.stamp == 0  # the simulation has not said a time yet


@pytest.mark.parametrize("opened", [own_node, over_dds], ids=["rclpy", "dds"])
@pytest.mark.parametrize(
    ("nodes", "word", "later", "is_simulated"),
    [
        ("/robot/arm", "true", "", True),
        ("robot/arm", "Yes", "", True),
        ("/**", "on", "", True),
        ("/*/arm", "Y", "", True),
        ("/robot/**", "true", "", True),
        ("arm", "true", "", False),
        ("/*", "true", "", False),
        ("/robot/arm", "true", "use_sim_time:=false", False),
        ("/**", "false", "use_sim_time:=true", True),
        ("/**", "false", "arm:use_sim_time:=true", False),
    ],
)
async def test_a_file_of_parameters_is_for_the_nodes_that_it_names(
    opened: Any, nodes: str, word: str, later: str, *, is_simulated: bool, tmp_path: Path
) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text(f"{nodes}: {{ros__parameters: {{use_sim_time: {word}, speed: 2}}}}")
    words = ["--ros-args", "--params-file", str(file), *(["-p", later] if later else [])]
    with anyio.fail_after(PATIENCE):
        async with opened(NodeSettings("arm", "robot", None, words)) as ros:
            assert ros.clock.is_the_machines is not is_simulated


@pytest.mark.parametrize("opened", [own_node, over_dds], ids=["rclpy", "dds"])
async def test_a_file_of_parameters_that_is_wrong_is_an_error_of_one_line(
    opened: Any, tmp_path: Path
) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text("speed: 2")
    words = ["--ros-args", "--params-file", str(file)]
    with pytest.raises(TransportError, match=f"--params-file .*{file.name}") as caught:
        async with opened(NodeSettings("arm", "robot", None, words)):
            raise AssertionError("there is a node")
    assert "\n" not in str(caught.value)


async def test_a_wake_up_without_a_request_is_ignored() -> None:
    async with own_node(NodeSettings()) as ros:
        for source in ros.sources._sources:
            assert source.take() is None


@pytest.mark.parametrize("level", ["metadata", "contents"])
async def test_services_publish_events_if_that_is_asked_for(level: str) -> None:
    url = f"{new_url()}&introspection={level}"
    place = url.partition("=")[2].partition("&")[0]
    service = Fibonacci.Impl.SendGoalService
    events: list[Any] = []
    with anyio.fail_after(PATIENCE), spun_node(place) as node:
        name = "fibonacci/_action/send_goal/_service_event"
        subscription = node.create_subscription(service.Event, name, events.append, 100)
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), url),
            connect(url, FIBONACCI) as client,
        ):

            async def publishers() -> int:
                return len(node.get_publishers_info_by_topic(subscription.topic_name))

            async def kinds() -> set[int]:
                await client.call(Goal(7))
                return {event.info.event_type for event in events}

            await eventually(publishers, lambda number: number == 2)
            # Sent and received, by the client and by the server.
            await eventually(kinds, lambda seen: seen == {0, 1, 2, 3})
    orders = {request.goal.order for event in events for request in event.request}
    assert orders == ({7} if level == "contents" else set())

"""`fibaction bridge` with a ROS graph on one side, and real rclpy in it."""

from __future__ import annotations

import uuid
from pathlib import Path

import anyio
import pytest

from fibaction import Action, ActionServer, ClientConnection, GoalStatus, connect, serve
from fibaction.cli.bridge.ends import open_end
from tests.ros2.stock.ours import action
from tests.ros2.stock.process import PATIENCE, peer
from tests.support.bridging import bridge
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.support.ports import free_port
from tests.transports.cyclone.dds_end import NINE, cyclone_client, cyclone_server, new_name
from tests.transports.cyclone.partner import needs_cyclone
from tests.transports.web.rosbridge.clients import SocketClient

pytestmark = pytest.mark.asyncio

FILES = Path(__file__).parents[2] / "examples/ros2"


async def test_a_server_of_rclpy_is_reached_without_ros(tmp_path: Path) -> None:
    url = f"unix://{tmp_path}/socket"
    async with (
        peer("server"),
        bridge("ros2://", url, "stock"),
        connect(url) as connection,
    ):
        (info,) = await connection.actions()
        assert (info.name, info.type_name) == ("stock", "arduinobot_msgs/action/Fibonacci")
        client = connection.client(action("stock"))
        async with client.send_goal(Goal(order=4)) as goal:
            feedback = [one.partial_sequence async for one in goal.feedback]
            result = await goal.result()

    assert feedback == [[0, 1, 1], [0, 1, 1, 2], [0, 1, 1, 2, 3]]
    assert result.sequence == [0, 1, 1, 2, 3]


async def test_a_server_of_rclpy_is_reached_by_a_program_for_rosbridge() -> None:
    port = free_port()
    async with (
        peer("server"),
        bridge("ros2://", f"http://127.0.0.1:{port}", "stock"),
        await anyio.connect_tcp("127.0.0.1", port) as stream,
    ):
        client = SocketClient(stream)
        await client.shake_hands({})
        await client.say(
            op="send_action_goal",
            id="one",
            action="/stock",
            action_type="arduinobot_msgs/action/Fibonacci",
            args={"order": 4},
            feedback=True,
        )
        *feedback, result = await client.hear_until("action_result")

    assert [one["values"]["partial_sequence"][-1] for one in feedback] == [1, 2, 3]
    assert (result["status"], result["values"]) == (4, {"sequence": [0, 1, 1, 2, 3]})


async def test_a_server_without_ros_is_reached_by_a_client_of_rclpy(tmp_path: Path) -> None:
    name = f"n{uuid.uuid4().hex}"
    async with (
        peer("client") as stock,  # the first, since Fast DDS may crash at an end just after another
        serve(ActionServer(FIBONACCI, fibonacci), f"unix://{tmp_path}/socket") as (url,),
        bridge(url, f"ros2://?namespace=/{name}"),
    ):
        sent = await stock.ask("send", action=f"/{name}/fibonacci", order=4)
        answer = await stock.ask("result", goal=sent["goal"])
        seen = await stock.ask("feedback", goal=sent["goal"])

    assert answer == {"status": GoalStatus.SUCCEEDED, "sequence": [0, 1, 1, 2, 3]}
    # On a busy machine, a client of rclpy may take the result first, and drop later feedback.
    assert seen == [[0, 1, 1], [0, 1, 1, 2], [0, 1, 1, 2, 3]][: len(seen)]


async def test_two_robots_without_ros_share_a_graph_by_their_namespaces(tmp_path: Path) -> None:
    fleet, one, two = f"n{uuid.uuid4().hex}", f"unix://{tmp_path}/one", f"unix://{tmp_path}/two"
    async with (
        peer("client") as stock,
        serve(ActionServer(FIBONACCI, fibonacci), one),
        serve(ActionServer(FIBONACCI, fibonacci), two),
        bridge(one, "ros2://", "--into", f"/{fleet}/robot1"),
        bridge(two, f"ros2://?namespace=/{fleet}", "--into", "/robot2"),
    ):
        for robot in ("robot1", "robot2"):
            sent = await stock.ask("send", action=f"/{fleet}/{robot}/fibonacci", order=2)
            answer = await stock.ask("result", goal=sent["goal"])
            assert answer == {"status": GoalStatus.SUCCEEDED, "sequence": [0, 1, 1]}


async def test_actions_that_come_later_are_bridged_into_ros_and_those_that_leave_are_not(
    tmp_path: Path,
) -> None:
    name, far = f"n{uuid.uuid4().hex}", f"unix://{tmp_path}/far"
    later = Action(
        "later", goal=Goal, feedback=Feedback, result=Result, type_name=FIBONACCI.type_name
    )

    async def listed(connection: ClientConnection, expected: set[str]) -> None:
        with anyio.fail_after(PATIENCE):
            while {info.name for info in await connection.actions()} != expected:  # noqa: ASYNC110
                await anyio.sleep(0.1)

    async with (
        ActionServer(FIBONACCI, fibonacci) as one,
        ActionServer(later, fibonacci) as other,
        open_end(far) as server,
    ):
        await server.add(one)
        async with (
            bridge(far, f"ros2://?namespace=/{name}"),
            connect(f"ros2://?namespace=/{name}") as near,
        ):
            await listed(near, {"fibonacci"})
            await server.remove("fibonacci")
            await server.add(other)
            await listed(near, {"later"})
            assert (await near.client(later).call(Goal(order=2))).sequence == [0, 1, 1]


@needs_cyclone
async def test_a_gateway_without_ros_joins_robots_and_clients_of_both_middlewares() -> None:
    near, cyclone_name = f"/n{uuid.uuid4().hex}", new_name()
    names = ("/stock", f"/{cyclone_name}")
    async with (
        peer("server"),
        cyclone_server(cyclone_name),
        bridge(f"dds://gateway?search={FILES}", f"dds://?search={FILES}", *names, "--into", near),
        peer("client") as stock,
    ):
        for name in names:
            sent = await stock.ask("send", action=near + name, order=9)
            answer = await stock.ask("result", goal=sent["goal"])
            assert answer == {"status": GoalStatus.SUCCEEDED, "sequence": NINE}
            async with cyclone_client((near + name)[1:]) as cyclone:
                sent = await cyclone.ask("send", order=9)
                answer = await cyclone.ask("result", goal=sent["goal"])
                assert answer == {"status": GoalStatus.SUCCEEDED, "sequence": NINE}
                assert await cyclone.ask("feedback", goal=sent["goal"], count=8)

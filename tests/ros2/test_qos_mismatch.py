"""Servers and clients with another quality of service: what is said, and how both are joined."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import anyio
import pytest
from arduinobot_msgs.action import Fibonacci
from rclpy.action import ActionServer as StockServer
from rclpy.action import GoalResponse
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from fibaction import ActionServer, ServerNotFound, connect, serve
from fibaction_transports.ros2.client.diagnosis import explain_mismatch
from fibaction_transports.ros2.settings import RosSettings
from tests.ros2.ends import client_of
from tests.ros2.spun import spun_node
from tests.support.fibonacci import FIBONACCI, Goal, Result, fibonacci
from tests.support.processes import PATIENCE
from tests.support.ros_ends import both_ends

pytestmark = pytest.mark.anyio


def execute(handle: Any) -> Any:
    handle.succeed()
    return Fibonacci.Result(sequence=[7])


@pytest.fixture
def stock(url: str) -> Generator[None, None, None]:
    """A stock server with best-effort feedback, and with statuses for no late subscriber."""
    with spun_node(url.partition("=")[2]) as node:
        server = StockServer(
            node,
            Fibonacci,
            "fibonacci",
            execute,
            goal_callback=lambda goal: GoalResponse.ACCEPT,
            feedback_pub_qos_profile=QoSProfile(
                depth=10, reliability=ReliabilityPolicy.BEST_EFFORT
            ),
            status_pub_qos_profile=QoSProfile(
                depth=1,
                reliability=ReliabilityPolicy.BEST_EFFORT,
                durability=DurabilityPolicy.VOLATILE,
            ),
        )
        yield
        server.destroy()  # the node does not, and would stay in the graph with it


WRONG = (
    "there is a server, and its QoS does not match: feedback: it offers best_effort, and this"
    " client wants reliable; status: it offers best_effort, and this client wants reliable; status:"
    " it offers volatile, and this client wants transient_local; connect with"
    " feedback_qos='best_effort', status_qos='best_effort,volatile', or change the server"
)


@pytest.mark.usefixtures("stock")
async def test_a_stock_server_whose_qos_does_not_match_is_named_with_what_to_do(
    url: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fibaction_transports.ros2.client.presence.MATCH_TIME", 0.5)
    with anyio.fail_after(PATIENCE):
        async with connect(f"{url}&discovery_timeout=1", FIBONACCI) as client:
            with pytest.raises(ServerNotFound) as caught:
                await client.send_goal(Goal(1))
            with pytest.raises(ServerNotFound):
                await client.wait_for_server(1)
    assert str(caught.value) == f"cannot reach the action 'fibonacci' in ROS: {WRONG}"
    assert [one.message for one in caplog.records] == [f"fibonacci cannot be reached yet: {WRONG}"]


async def test_nothing_is_said_of_a_server_that_is_not_there(
    url: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fibaction_transports.ros2.client.presence.MATCH_TIME", 0.0)
    async with connect(url, FIBONACCI) as client:
        with pytest.raises(ServerNotFound):
            await client.wait_for_server(0.2)
    assert caplog.records == []


@pytest.mark.usefixtures("stock")
async def test_a_client_with_the_qos_of_a_stock_server_uses_it(url: str) -> None:
    settings = "feedback_qos=best_effort&status_qos=best_effort,volatile"
    with anyio.fail_after(PATIENCE):
        async with connect(f"{url}&{settings}", FIBONACCI) as client:
            assert await client.call(Goal(1)) == Result([7])


async def test_services_that_do_not_match_are_named(url: str) -> None:
    with anyio.fail_after(PATIENCE):
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), f"{url}&services_qos=best_effort"),
            connect(f"{url}&discovery_timeout=1", FIBONACCI) as client,
        ):
            with pytest.raises(ServerNotFound, match="service send_goal: it offers best_effort,"):
                await client.send_goal(Goal(1))


async def test_a_client_that_offers_too_little_is_named(url: str) -> None:
    with anyio.fail_after(PATIENCE):
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), url),
            connect(f"{url}&discovery_timeout=1&services_qos=best_effort", FIBONACCI) as client,
        ):
            with pytest.raises(ServerNotFound) as caught:
                await client.send_goal(Goal(1))
    assert (
        "service get_result: it wants reliable, and this client offers best_effort; connect with"
        " services_qos='reliable', or change the server"
    ) in str(caught.value)


async def test_nothing_is_said_of_a_server_that_matches(url: str) -> None:
    async with both_ends(url) as client:
        await client.wait_for_server()
        presence = client_of(client.endpoint).presence
        said = explain_mismatch(presence._ros, presence._names, RosSettings())
    assert said == ""

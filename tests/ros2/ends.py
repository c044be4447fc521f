"""Both ends of an action over ROS, in the process of the tests."""

from __future__ import annotations

import uuid
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from functools import cache
from queue import Queue
from typing import Any

import anyio

from fibaction import ActionServer, GoalHandle, GoalID, connect, serve
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.client.action_client import RosActionClient
from fibaction_transports.ros2.client.goal_stream import GoalDecoder, RosGoalStream
from fibaction_transports.ros2.on_rclpy.ends import profile_of
from fibaction_transports.ros2.on_rclpy.rcl import GoalInfoMessage, uuid_of
from tests.ros2.spun import spun_node
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result
from tests.support.processes import PATIENCE

Items = AsyncGenerator[Feedback | Result, None]


def new_url() -> str:
    """Return a URL with a namespace of its own."""
    return f"ros2://?namespace=/t{uuid.uuid4().hex}"


async def forever(goal: GoalHandle[Goal]) -> Items:
    yield Feedback([1])
    await anyio.sleep_forever()
    yield Result([])


@asynccontextmanager
async def raw_client(
    url: str, server: ActionServer[Goal, Feedback, Result]
) -> AsyncGenerator[RosActionClient, None]:
    """Serve, and give the part of the client that sends raw requests."""
    with anyio.fail_after(PATIENCE):
        async with serve(server, url), connect(url) as connection:
            await connection.endpoint(FIBONACCI).wait_for_server()
            yield client_of(connection.endpoint(FIBONACCI))


@cache
def tells_publishers() -> bool:
    """Return whether rclpy tells the publisher of a message, as it does since Kilted."""
    infos: Queue[Any] = Queue()
    # A message that is sent before the subscription arrives, too.
    profile = profile_of(qos.subscribed_status())

    def take(message: Any, info: Any) -> None:
        infos.put(info)

    with spun_node(f"/t{uuid.uuid4().hex}") as node:
        node.create_publisher(GoalInfoMessage, "told", profile).publish(GoalInfoMessage())
        node.create_subscription(GoalInfoMessage, "told", take, profile)
        return "publisher_gid" in infos.get(timeout=PATIENCE)


def client_of(endpoint: Any) -> RosActionClient:
    """Return the part of an endpoint that sends raw requests."""
    client: RosActionClient = endpoint._client
    return client


def node_of(client: Any) -> Any:
    """Return rclpy's node of a client."""
    ros: Any = client_of(client.endpoint).presence._ros
    return ros.node


class Undecoded(GoalDecoder):
    """Gives everything as it has arrived."""

    def feedback(self, message: bytes) -> bytes:
        return message

    def outcome(self, response: Any) -> Any:
        return response


async def send(client: RosActionClient, goal_id: GoalID, order: int) -> Any:
    """Send a goal, and return the response."""
    request = client.impl.SendGoalService.Request()
    request.goal_id.uuid = uuid_of(goal_id)
    request.goal.order = order
    return await client._goals.call(request)


async def result_of(client: RosActionClient, goal_id: GoalID) -> Any:
    """Request a result, and return the response."""
    stream = RosGoalStream(goal_id, Undecoded(), 10, reads=False)
    client._follow(stream)
    client._followed.request_result(stream)
    return await stream.outcome()

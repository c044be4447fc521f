"""Nodes of rclpy on two middlewares at the same time, at ends of fibaction over `dds://`.

One of them is on Fast DDS, and the other one on the middleware of this environment: on Fast DDS as
well, unless the tests run with Cyclone DDS, as the page "ROS 2" describes.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import Action, ActionServer, GoalHandle, GoalStatus, Return, connect, serve
from tests.ros2.stock import orders
from tests.ros2.stock.ours import Behaviour, action
from tests.ros2.stock.process import Peer, peer
from tests.support.fibonacci import Feedback, Goal, Result

pytestmark = pytest.mark.anyio

FAST_DDS = {"LD_PRELOAD": "", "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}
"""The environment of a process that is on Fast DDS in any case."""
MIDDLEWARES: dict[str, dict[str, str]] = {"own": {}, "fast": FAST_DDS}
MEGABYTE = 1_000_000
PATIENCE = 40.0
NINE = [0, 1, 1, 2, 3, 5, 8, 13, 21, 34]
NINE_TERMS = [NINE[: size + 2] for size in range(1, 9)]
SUCCEEDED, CANCELED = int(GoalStatus.SUCCEEDED), int(GoalStatus.CANCELED)


class Text(msgspec.Struct):
    text: str


def echo(name: str) -> Action[Text, Text, Text]:
    return Action(
        name, goal=Text, feedback=Text, result=Text, type_name="fibaction_test_msgs/action/Echo"
    )


async def execute_echo(goal: GoalHandle[Text]) -> AsyncGenerator[Text | Return[Text], None]:
    yield goal.request
    yield Return(goal.request)


@pytest.fixture(params=MIDDLEWARES)
def environment(request: pytest.FixtureRequest) -> dict[str, str]:
    """The environment of a node of rclpy, by its middleware."""
    return MIDDLEWARES[request.param]


@asynccontextmanager
async def two(*arguments: str) -> AsyncGenerator[list[Peer], None]:
    """Run a program on both middlewares."""

    def start(environment: dict[str, str]) -> AbstractAsyncContextManager[Peer]:
        return peer(*arguments, **environment)

    async with start(MIDDLEWARES["own"]) as own, start(MIDDLEWARES["fast"]) as fast:
        yield [own, fast]


async def nine(stock: Peer) -> None:
    """Run a goal with feedback at our server."""
    sent = await stock.ask("send", action="two", order=9)
    assert await stock.ask("result", goal=sent["goal"]) == {"status": SUCCEEDED, "sequence": NINE}
    feedback = await stock.ask("feedback", goal=sent["goal"])
    # rclpy drops what does not fit into its queue beside the other's, and what it reads too late.
    assert feedback == [terms for terms in NINE_TERMS if terms in feedback]


async def test_clients_on_two_middlewares_use_one_server_at_the_same_time() -> None:
    behaviour = Behaviour()
    async with serve(behaviour.server("two"), "dds://our_server"), two("client") as clients:

        async def use(stock: Peer) -> None:
            assert await stock.ask("ready", action="two")
            for _ in range(10):
                await nine(stock)
            many = await stock.ask("send_many", action="two", orders=[2] * 8)
            assert many == [{"status": SUCCEEDED, "sequence": [0, 1, 1]}] * 8

        with anyio.fail_after(PATIENCE):
            async with anyio.create_task_group() as tasks:
                for stock in clients:
                    tasks.start_soon(use, stock)


async def test_one_client_uses_servers_on_two_middlewares() -> None:
    async with (
        peer("server", "--ros-args", "-r", "__ns:=/own", **MIDDLEWARES["own"]),
        peer("server", "--ros-args", "-r", "__ns:=/fast", **MIDDLEWARES["fast"]),
        connect("dds://our_client") as connection,
    ):
        outcomes: list[Any] = []

        async def use(name: str) -> None:
            client = connection.client(action(name))
            for _ in range(10):
                async with client.send_goal(Goal(9)) as goal:
                    feedback = [each.partial_sequence async for each in goal.feedback]
                    assert await goal.result() == Result(NINE)
                assert feedback == NINE_TERMS
            async with client.send_goal(Goal(orders.WAITS)) as goal:
                assert await anext(goal.feedback) == Feedback([1])
                await goal.cancel()
                outcomes.append((await goal.outcome()).status)

        with anyio.fail_after(PATIENCE):
            async with anyio.create_task_group() as tasks:
                for name in ("own/stock", "fast/stock"):
                    tasks.start_soon(use, name)
        assert outcomes == [GoalStatus.CANCELED] * 2


async def test_a_goal_of_a_megabyte_reaches_a_stock_server(environment: dict[str, str]) -> None:
    text = "o" * MEGABYTE
    async with (
        peer("echo", "server", "large", **environment),
        connect("dds://our_client", echo("large")) as client,
    ):
        with anyio.fail_after(PATIENCE):
            async with client.send_goal(Text(text)) as goal:
                assert [each.text == text async for each in goal.feedback] == [True]
                assert (await goal.result()).text == text


async def test_a_goal_of_a_megabyte_comes_from_a_stock_client(environment: dict[str, str]) -> None:
    async with (
        serve(ActionServer(echo("large"), execute_echo), "dds://our_server"),
        peer("echo", "client", "large", **environment) as stock,
    ):
        answer = await stock.ask("call", text="o" * MEGABYTE)
        assert (answer["status"], answer["is_same"]) == (SUCCEEDED, True)
        assert all(answer["feedback"])

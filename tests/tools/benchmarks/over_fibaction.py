"""fibaction over each of its transports, as users write it.

`FIBACTION_BENCH_FLEET` is the URL of a fleet over `nats://`, whose brokers must be running. Both
ends of `ros2` run with the Python that has ROS 2, and no end of `dds` imports rclpy.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import Any

import anyio
import msgspec

import fibaction
from fibaction import Action, ActionClient, ActionServer, ClientGoal, GoalHandle, Return
from fibaction.cli.verbs.serve import rare_collections
from fibaction.wire.settings import Limits
from tests.support import fibonacci
from tests.support.certificates import HOST, pems
from tests.tools.benchmarks.contender import (
    ACTION_NAME,
    LARGE,
    LARGE_PAUSE,
    PENDING,
    Contender,
    Ends,
    GoalTimes,
)
from tests.tools.benchmarks.inprocess import ACTION, Goal, count, executor

KEPT: dict[str, Any] = {"result_timeout": math.inf, "max_results": 1_000_000}
"""The settings of a server that keeps all results for ever."""
LIMITS = Limits(goals=20_000)
"""The limits for one client with more than 10,000 pending goals."""
FLEET = "FIBACTION_BENCH_FLEET"


@asynccontextmanager
async def serve(where: str = "tcp://127.0.0.1:0", **settings: Any) -> AsyncGenerator[str, None]:
    """Serve; `settings` are the server's."""
    server = ActionServer(ACTION, count, stall_timeout=math.inf, **settings)
    async with fibaction.serve(server, where, limits=LIMITS) as (url,):
        yield url


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    async with fibaction.connect(address, ACTION) as client:
        yield OverFibaction(client, Goal, lambda feedback: feedback.numbers)


@asynccontextmanager
async def serve_tls() -> AsyncGenerator[str, None]:
    """Serve with a certificate, which the client checks."""
    files = pems()
    async with serve(f"tls://{HOST}:0?cert={files.cert}") as url:
        yield f"{url}?ca={files.ca}"


@asynccontextmanager
async def serve_unix() -> AsyncGenerator[str, None]:
    with TemporaryDirectory() as folder:
        async with serve(f"unix://{Path(folder, 'socket')}") as url:
            yield url


@asynccontextmanager
async def connect_inproc(address: str, **settings: Any) -> AsyncGenerator[Contender, None]:
    """Serve in the client's process; `settings` are the server's."""
    async with serve("inproc://benchmark", **settings) as url, connect(url) as contender:
        yield contender


@asynccontextmanager
async def serve_fleet() -> AsyncGenerator[str, None]:
    with rare_collections():
        async with serve(os.environ[FLEET]):
            yield os.environ[FLEET]


class Text(msgspec.Struct):
    text: str


def action_of_ros(name: str) -> Action[fibonacci.Goal, fibonacci.Feedback, fibonacci.Result]:
    return Action(
        name,
        goal=fibonacci.Goal,
        feedback=fibonacci.Feedback,
        result=fibonacci.Result,
        type_name="arduinobot_msgs/action/Fibonacci",
    )


def large_action_of_ros(name: str) -> Action[Text, Text, Text]:
    """Return an action with large feedback; its goal is the number of messages as text."""
    echo = "fibaction_test_msgs/action/Echo"
    return Action(f"{name}_large", goal=Text, feedback=Text, result=Text, type_name=echo)


execute_of_ros = executor(
    lambda goal: goal.order, fibonacci.Feedback, lambda wanted: fibonacci.Result([wanted])
)


async def execute_large(goal: GoalHandle[Text]) -> AsyncGenerator[Text | Return[Text], None]:
    feedback = Text("x" * LARGE)
    for _ in range(int(goal.request.text)):
        await anyio.sleep(LARGE_PAUSE)
        yield feedback
    yield Return(Text("done"))


@asynccontextmanager
async def serve_ros2() -> AsyncGenerator[str, None]:
    server = ActionServer(action_of_ros("benchmark_fibaction"), execute_of_ros)
    async with fibaction.serve(server, "ros2://benchmark"):
        yield "ros2://"


@asynccontextmanager
async def connect_ros2(address: str) -> AsyncGenerator[Contender, None]:
    async with fibaction.connect(address, action_of_ros("benchmark_fibaction")) as client:
        await client.wait_for_server()
        yield OverFibaction(client, fibonacci.Goal, lambda feedback: feedback.partial_sequence)


@asynccontextmanager
async def serve_dds(**settings: Any) -> AsyncGenerator[str, None]:
    name = os.environ[ACTION_NAME]
    servers = (
        ActionServer(action_of_ros(name), execute_of_ros, **settings),
        ActionServer(large_action_of_ros(name), execute_large),
    )
    async with fibaction.serve(servers, "dds://benchmark_server"):
        yield name


@asynccontextmanager
async def connect_dds(address: str) -> AsyncGenerator[Contender, None]:
    async with fibaction.connect("dds://benchmark_client") as connection:
        small = connection.client(action_of_ros(address))
        large = connection.client(large_action_of_ros(address))
        await small.wait_for_server()
        await large.wait_for_server()
        yield OverDds(small, large)


ENDS = {
    "ws": Ends(partial(serve, "ws://127.0.0.1:0"), connect),
    "tls": Ends(serve_tls, connect),
    "unix": Ends(serve_unix, connect),
    "kept": Ends(partial(serve, **KEPT), connect),
    "inproc": Ends(serve, connect_inproc),
    "inproc_kept": Ends(serve, partial(connect_inproc, **KEPT)),
    "fleet": Ends(serve_fleet, connect),
    "ros2": Ends(serve_ros2, connect_ros2),
    "dds": Ends(serve_dds, connect_dds),
    **{
        f"dds_{count}": Ends(
            partial(serve_dds, max_results=count, result_timeout=math.inf), connect_dds
        )
        for count in (10, 1000)
    },
}
"""The ways beside `tcp://`, by their names."""


class OverFibaction(Contender):
    def __init__(
        self,
        client: ActionClient[Any, Any, Any],
        goal: Callable[[int], Any],
        numbers: Callable[[Any], list[int]],
    ) -> None:
        self._client = client
        self._goal = goal
        self._numbers = numbers
        self._pending: list[ClientGoal[Any, Any]] = []

    async def goal(self) -> None:
        await self._client.call(self._goal(0))

    async def numbers_of(self, goal: int) -> AsyncGenerator[list[int], None]:
        async with self._client.send_goal(self._goal(goal)) as sent:
            async for feedback in sent.feedback:
                yield self._numbers(feedback)
            await sent.result()

    async def goal_times(self, times: int) -> list[GoalTimes]:
        taken: list[GoalTimes] = []
        for _ in range(times):
            start = perf_counter()
            goal = await self._client.send_goal(self._goal(0))
            accepted = perf_counter() - start
            await goal.result()
            taken.append(GoalTimes(accepted, perf_counter() - start))
        return taken

    async def hold(self, times: int) -> None:
        for _ in range(times):
            self._pending.append(await self._client.send_goal(self._goal(PENDING)))


class OverDds(OverFibaction):
    def __init__(
        self, client: ActionClient[Any, Any, Any], large: ActionClient[Text, Text, Text]
    ) -> None:
        super().__init__(client, fibonacci.Goal, lambda feedback: feedback.partial_sequence)
        self._large = large

    async def large(self, times: int) -> list[float]:
        arrived, start, used = 0, perf_counter(), process_time()
        async with self._large.send_goal(Text(str(times))) as goal:
            async for feedback in goal.feedback:
                arrived += len(feedback.text) == LARGE
            await goal.result()
        assert "rclpy" not in sys.modules
        return [arrived, perf_counter() - start, process_time() - used]

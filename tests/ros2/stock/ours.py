"""Servers and clients of fibaction, in the process of the tests or in one of their own.

`python -m tests.ros2.stock.ours WAY ACTION BACKEND`, where a way is one of the functions below.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import AsyncGenerator, Awaitable, Callable
from threading import Thread
from typing import Any

import anyio
import rclpy
from rclpy.executors import SingleThreadedExecutor

from fibaction import (
    Action,
    ActionServer,
    CancelRejected,
    GoalAborted,
    GoalHandle,
    GoalRejected,
    connect,
    serve,
)
from fibaction._runtime.notify import Notifier
from fibaction_transports.ros2 import Ros2Transport
from tests.ros2.stock import orders
from tests.ros2.stock.telling import say, spin
from tests.support.fibonacci import Feedback, Goal, Result

TYPE = "arduinobot_msgs/action/Fibonacci"


def action(name: str, type_name: str = TYPE) -> Action[Goal, Feedback, Result]:
    return Action(name, goal=Goal, feedback=Feedback, result=Result, type_name=type_name)


class Behaviour:
    """Executes a goal as its order says."""

    def __init__(self) -> None:
        self.released = Notifier()

    def on_goal(self, goal: Goal) -> None:
        if goal.order == orders.GOAL_RAISES:
            raise ValueError("no such arm")
        if goal.order < 0:
            raise GoalRejected("a sequence has no negative length")

    def on_cancel(self, goal: GoalHandle[Goal]) -> None:
        if goal.request.order == orders.STUBBORN:
            raise CancelRejected("the pen would fall")
        if goal.request.order == orders.CANCEL_RAISES:
            raise ValueError("no such pen")

    async def execute(self, goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        order = goal.request.order
        if order <= orders.MOST:
            sequence = [0, 1]
            for _ in range(1, order):
                sequence.append(sequence[-1] + sequence[-2])
                yield Feedback(sequence)
            yield Result(sequence)
        elif order >= orders.RATED:
            for number in range(order - orders.RATED):
                yield Feedback([number])
                await anyio.sleep(orders.PERIOD)
            yield Result([])
        elif order >= orders.BURST:
            for number in range(order - orders.BURST):
                yield Feedback([number])
            yield Result([order])
        elif order == orders.WAITS:
            yield Feedback([1])
            await anyio.sleep_forever()
        elif order == orders.ABORTS:
            raise GoalAborted("the pen is lost", result=Result(orders.PART))
        elif order == orders.RAISES:
            raise ValueError("no such arm")
        elif order in (orders.STUBBORN, orders.CANCEL_RAISES):
            yield Feedback([1])
            await self.released.wait()
            yield Result(orders.PART)
        elif order == orders.RELEASES:
            self.released.notify()
            yield Result([])

    def server(self, name: str, **settings: Any) -> ActionServer[Goal, Feedback, Result]:
        return ActionServer(
            action(name), self.execute, on_goal=self.on_goal, on_cancel=self.on_cancel, **settings
        )


async def until_told(work: Awaitable[None]) -> None:
    """Work until standard input ends, or there is a SIGTERM. A Ctrl-C ends it by itself."""
    async with anyio.create_task_group() as tasks:

        async def end_with(wait: Callable[[], Awaitable[object]]) -> None:
            await wait()
            tasks.cancel_scope.cancel()

        tasks.start_soon(end_with, terminated)
        tasks.start_soon(end_with, lambda: anyio.wait_readable(sys.stdin.fileno()))
        await work


async def terminated() -> None:
    with anyio.open_signal_receiver(signal.SIGTERM) as signals:
        async for _ in signals:
            return


async def serve_it(name: str) -> None:
    """Serve the action."""
    async with serve(Behaviour().server(name), "ros2://our_server"):
        say("ready")
        await anyio.sleep_forever()


async def serve_at_a_node(name: str) -> None:
    """Serve it at a node of the user, where rclpy's own handlers of signals are installed."""
    rclpy.init()
    node = rclpy.create_node("users_node")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    spinner = Thread(target=spin, args=(executor,))
    spinner.start()
    try:
        async with serve(Behaviour().server(name), Ros2Transport(node=node)):
            say("ready")
            await anyio.sleep_forever()
    finally:
        rclpy.try_shutdown()
        spinner.join()
        node.destroy_node()


async def wait(name: str) -> None:
    """Send a goal that does not end, and wait for its result."""
    async with connect("ros2://our_client", action(name)) as client:
        await client.wait_for_server(10)
        async with client.send_goal(Goal(orders.WAITS)) as goal:
            say("ready")
            await goal.result()


async def look_for(name: str) -> None:
    """Wait for a server."""
    async with connect("ros2://our_client", action(name)) as client:
        say("ready")
        await client.wait_for_server()


async def leave_with_an_error(name: str) -> None:
    """End the program in the middle of a block."""
    async with (
        serve(Behaviour().server(name), "ros2://"),
        connect("ros2://", action(name)) as client,
    ):
        await client.wait_for_server(10)
        await client.send_goal(Goal(orders.WAITS))
        say("ready")
        sys.exit(7)


async def abandon(name: str) -> None:
    """End without leaving the block."""
    client = await connect("ros2://", action(name)).__aenter__()
    ABANDONED.append(client)
    say("ready")


ABANDONED: list[object] = []
"""Objects that are still there when Python ends."""
WAYS = {one.__name__: one for one in (serve_it, serve_at_a_node, wait, look_for)}
BY_THEMSELVES = {one.__name__: one for one in (leave_with_an_error, abandon)}


async def main(way: str, name: str) -> None:
    if way in WAYS:
        await until_told(WAYS[way](name))
    else:
        await BY_THEMSELVES[way](name)


if __name__ == "__main__":
    way, name, backend = sys.argv[1:]
    code = 0
    try:
        anyio.run(main, way, name, backend=backend)
    except* KeyboardInterrupt:  # trio has it in a group
        code = 128 + signal.SIGINT
    sys.exit(code)

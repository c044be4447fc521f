"""`python -m tests.tools.benchmarks.ros2_rclpy server|client|once [NAME]`: stock rclpy.

It is written as its users write it.

`once` is a whole program: one goal, and its result.
"""

from __future__ import annotations

import sys
import time
from contextlib import suppress
from time import perf_counter
from typing import Any

import rclpy
from arduinobot_msgs.action import Fibonacci
from fibaction_test_msgs.action import Echo
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from tests.ros2.stock.telling import say, shut_down_at_the_end, told
from tests.tools.benchmarks.ros2_orders import LARGE, LARGE_PAUSE, LONG, most_memory

NAME = "benchmark_rclpy"


class Server(Node):  # type: ignore[misc]  # rclpy has no types here
    def __init__(self, name: str) -> None:
        super().__init__("benchmark_server")
        self._server = ActionServer(self, Fibonacci, name, self.execute)
        self._large = ActionServer(self, Echo, f"{name}_large", self.execute_large)

    async def execute(self, handle: Any) -> Any:
        order = handle.request.order
        if order > LONG:
            feedback = Fibonacci.Feedback(partial_sequence=[0, 1, 1])
            for _ in range(order - LONG):
                handle.publish_feedback(feedback)
            order = 0
        sequence = [0, 1]
        for _ in range(1, order):
            sequence.append(sequence[-1] + sequence[-2])
            handle.publish_feedback(Fibonacci.Feedback(partial_sequence=sequence))
        handle.succeed()
        return Fibonacci.Result(sequence=sequence)

    def execute_large(self, handle: Any) -> Any:
        feedback = Echo.Feedback(text="x" * LARGE)
        for _ in range(int(handle.request.text)):
            time.sleep(LARGE_PAUSE)  # noqa: TID251  # as users of rclpy do it
            handle.publish_feedback(feedback)
        handle.succeed()
        return Echo.Result(text="done")


class Client:
    def __init__(self, name: str) -> None:
        self.node = rclpy.create_node("benchmark_client")
        self._client = ActionClient(self.node, Fibonacci, name)
        # An executor of its own is faster than rclpy's global one, which adds the node each time.
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._arrived = 0

    def wait_for_server(self) -> None:
        self._client.wait_for_server()

    def _wait(self, future: Any) -> Any:
        self._executor.spin_until_future_complete(future)
        return future.result()

    def _call(self, order: int, on_feedback: Any = None) -> Any:
        goal = Fibonacci.Goal(order=order)
        handle = self._wait(self._client.send_goal_async(goal, feedback_callback=on_feedback))
        return self._wait(handle.get_result_async())

    def goals(self, times: int) -> list[float]:
        seconds: list[float] = []
        for _ in range(times):
            start = perf_counter()
            self._call(0)
            seconds.append(perf_counter() - start)
        return seconds

    def _count(self, _: Any) -> None:
        self._arrived += 1

    def feedback(self, times: int, order: int) -> list[float]:
        self._arrived = 0
        start = perf_counter()
        for _ in range(times):
            self._call(order, self._count)
        return [self._arrived, perf_counter() - start]


def run_server(name: str) -> None:
    server = Server(name)
    shut_down_at_the_end()
    say("ready")
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(server)


def run_client(name: str) -> None:
    client = Client(name)
    client.wait_for_server()
    say("ready")
    for order in told():
        say({"answer": getattr(client, order.pop("do"))(**order)})


def run_once(name: str) -> None:
    client = Client(name)
    client.wait_for_server()
    client.goals(1)
    say([time.time(), most_memory()])


if __name__ == "__main__":
    rclpy.init()
    ways = {"server": run_server, "client": run_client, "once": run_once}
    ways[sys.argv[1]]((*sys.argv[2:], NAME)[0])

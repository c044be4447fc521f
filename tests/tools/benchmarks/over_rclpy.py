"""Stock rclpy, as its users write it. Both ends run with the Python that has ROS 2.

The client blocks while it waits, as programs of rclpy do: nothing else runs in its process.
"""

from __future__ import annotations

import os
import time
from collections.abc import AsyncGenerator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from functools import partial
from threading import Thread
from time import perf_counter
from typing import Any

import rclpy
from arduinobot_msgs.action import Fibonacci
from fibaction_test_msgs.action import Echo
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future

from tests.tools.benchmarks.contender import (
    ACTION_NAME,
    AT_ONCE,
    LARGE,
    LARGE_PAUSE,
    PACED,
    PAUSE,
    Contender,
    Ends,
    GoalTimes,
    seconds_since,
    stamped,
)

NAME = os.environ.get(ACTION_NAME, "benchmark_rclpy")
DEEP = QoSProfile(depth=3000)
SERVICES = {f"{name}_service_qos_profile": DEEP for name in ("goal", "result", "cancel")}
SUCCEEDED = 4
PATIENCE = 10.0
"""Seconds of one turn of an executor; goals of a batch not answered by then count as lost."""


class Server(Node):  # type: ignore[misc]  # rclpy has no types here
    def __init__(self, name: str, settings: Mapping[str, Any]) -> None:
        super().__init__("benchmark_server")
        self._server = ActionServer(self, Fibonacci, name, self.execute, **settings)
        if ACTION_NAME in os.environ:
            self._large = ActionServer(self, Echo, f"{name}_large", self.execute_large)

    async def execute(self, handle: Any) -> Any:
        wanted = handle.request.order
        if wanted >= PACED:
            await self._publish_paced(handle, wanted - PACED)
        else:
            feedback = Fibonacci.Feedback(partial_sequence=[1, 2, 3])
            for _ in range(wanted):
                handle.publish_feedback(feedback)
        handle.succeed()
        return Fibonacci.Result(sequence=[wanted])

    def execute_large(self, handle: Any) -> Any:
        feedback = Echo.Feedback(text="x" * LARGE)
        for _ in range(int(handle.request.text)):
            time.sleep(LARGE_PAUSE)  # noqa: TID251  # as users of rclpy do it
            handle.publish_feedback(feedback)
        handle.succeed()
        return Echo.Result(text="done")

    async def _publish_paced(self, handle: Any, times: int) -> None:
        published = 0
        done = Future()

        def publish() -> None:
            nonlocal published
            handle.publish_feedback(Fibonacci.Feedback(partial_sequence=stamped()))
            published += 1
            if published == times:
                timer.cancel()
                done.set_result(None)

        timer = self.create_timer(PAUSE, publish)
        await done
        self.destroy_timer(timer)


def spin(node: Node, make_executor: Callable[[], Executor]) -> None:
    executor = make_executor()
    executor.add_node(node)
    # Without a timeout, rclpy's EventsExecutor never returns: it keeps the interpreter's lock.
    with suppress(ExternalShutdownException):
        while rclpy.ok():
            executor.spin_once(PATIENCE)


@asynccontextmanager
async def serve(
    name: str = NAME, executor: Callable[[], Executor] = SingleThreadedExecutor, **settings: Any
) -> AsyncGenerator[str, None]:
    rclpy.init()
    spinner = Thread(target=spin, args=(Server(name, settings), executor), daemon=True)
    spinner.start()
    try:
        yield name
    finally:
        rclpy.try_shutdown()
        spinner.join(1)


@asynccontextmanager
async def connect(
    address: str, executor: Callable[[], Executor] = SingleThreadedExecutor, **settings: Any
) -> AsyncGenerator[Contender, None]:
    rclpy.init()
    try:
        yield OverRclpy(address, executor, settings)
    finally:
        rclpy.try_shutdown()


def events_executor() -> Executor:
    from rclpy.experimental import EventsExecutor  # here, because the others need no new rclpy

    return EventsExecutor()


def deep(name: str, executor: Callable[[], Executor]) -> Ends:
    """Return ends with queues for a whole batch instead of the default of ten."""
    return Ends(
        partial(serve, name, executor, feedback_pub_qos_profile=DEEP, **SERVICES),
        partial(connect, executor=executor, feedback_sub_qos_profile=DEEP, **SERVICES),
    )


ENDS = {
    "deep": deep("benchmark_rclpy_deep", SingleThreadedExecutor),
    "events": deep("benchmark_rclpy_events", events_executor),
}
"""The ways with other settings; the second has rclpy's newest executor at both ends."""


class OverRclpy(Contender):
    def __init__(
        self, name: str, executor: Callable[[], Executor], settings: Mapping[str, Any]
    ) -> None:
        node = rclpy.create_node("benchmark_client")
        self._client = ActionClient(node, Fibonacci, name, **settings)
        # An executor of its own is faster than rclpy's global one, which adds the node each time.
        self._executor = executor()
        self._executor.add_node(node)
        self._client.wait_for_server()

    async def goal(self) -> None:
        self._call(0)

    async def batches(self, times: int) -> int:
        return sum(self._batch() for _ in range(times))

    def _batch(self) -> int:
        done = 0
        all_done = Future()

        def finished(result: Any) -> None:
            nonlocal done
            done += result.result().status == SUCCEEDED
            if done == AT_ONCE:
                all_done.set_result(None)

        def accepted(sent: Any) -> None:
            sent.result().get_result_async().add_done_callback(finished)

        for _ in range(AT_ONCE):
            self._client.send_goal_async(Fibonacci.Goal()).add_done_callback(accepted)
        self._executor.spin_until_future_complete(all_done, PATIENCE)
        return done

    async def feedback(self, times: int) -> int:
        arrived: list[Any] = []
        self._call(times, arrived.append)
        return len(arrived)

    async def goal_times(self, times: int) -> list[GoalTimes]:
        taken: list[GoalTimes] = []
        for _ in range(times):
            start = perf_counter()
            handle = self._wait(self._client.send_goal_async(Fibonacci.Goal()))
            accepted = perf_counter() - start
            self._wait(handle.get_result_async())
            taken.append(GoalTimes(accepted, perf_counter() - start))
        return taken

    async def feedback_times(self, times: int) -> list[float]:
        taken: list[float] = []

        def take(message: Any) -> None:
            taken.append(seconds_since(list(message.feedback.partial_sequence)))

        self._call(PACED + times, take)
        return taken

    def _call(self, order: int, on_feedback: Any = None) -> None:
        goal = Fibonacci.Goal(order=order)
        handle = self._wait(self._client.send_goal_async(goal, feedback_callback=on_feedback))
        self._wait(handle.get_result_async())

    def _wait(self, future: Any) -> Any:
        while not future.done() and rclpy.ok():
            self._executor.spin_until_future_complete(future, PATIENCE)
        return future.result()

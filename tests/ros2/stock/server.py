"""A stock server of rclpy: `/stock`, `/stock_usual` with the default of rclpy for the time that
results are kept, and `/stock_hasty`, which forgets them quickly.
"""

from __future__ import annotations

import time
from threading import Event, Thread
from typing import Any

import rclpy
from arduinobot_msgs.action import Fibonacci
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor

from tests.ros2.stock import orders
from tests.ros2.stock.telling import leave, say, spin, told

RESULT_TIMEOUT = 0.5


class Server:
    def __init__(self) -> None:
        self.node = rclpy.create_node("stock_server")
        self._deferred: list[Any] = []
        self._released = Event()
        for name, seconds in (
            ("stock", 60),
            ("stock_usual", 10),
            ("stock_hasty", RESULT_TIMEOUT),
        ):
            ActionServer(
                self.node,
                Fibonacci,
                name,
                self.execute,
                callback_group=ReentrantCallbackGroup(),
                goal_callback=self.goal,
                handle_accepted_callback=self.accepted,
                cancel_callback=self.cancel,
                result_timeout=seconds,
            )

    def goal(self, goal: Any) -> GoalResponse:
        return GoalResponse.REJECT if goal.order < 0 else GoalResponse.ACCEPT

    def accepted(self, handle: Any) -> None:
        if handle.request.order == orders.DEFERRED:
            self._deferred.append(handle)
            return
        if handle.request.order == orders.RELEASES:
            self._released.set()
            for other in self._deferred:
                if other.is_active:
                    other.execute()
            self._deferred.clear()
        handle.execute()

    def cancel(self, handle: Any) -> CancelResponse:
        if handle.request.order == orders.STUBBORN:
            return CancelResponse.REJECT
        return CancelResponse.ACCEPT

    def execute(self, handle: Any) -> Any:
        order = handle.request.order
        if order <= orders.MOST:
            return self.compute(handle)
        if order >= orders.RATED:
            return self.tell(handle)
        if order >= orders.BURST:
            handle.succeed()
            return Fibonacci.Result()
        return {
            orders.WAITS: self.wait,
            orders.ABORTS: self.abort,
            orders.RAISES: self.fail,
            orders.STUBBORN: self.be_stubborn,
            orders.RELEASES: self.compute,
            orders.DEFERRED: self.end_deferred,
            orders.FORGETS: self.forget,
        }[order](handle)

    def compute(self, handle: Any) -> Any:
        sequence = [0, 1]
        for _ in range(1, min(handle.request.order, 9)):
            sequence.append(sequence[-1] + sequence[-2])
            handle.publish_feedback(Fibonacci.Feedback(partial_sequence=sequence))
        handle.succeed()
        return Fibonacci.Result(sequence=sequence)

    def tell(self, handle: Any) -> Any:
        for number in range(handle.request.order - orders.RATED):
            handle.publish_feedback(Fibonacci.Feedback(partial_sequence=[number]))
            time.sleep(orders.PERIOD)  # noqa: TID251  # as users of rclpy do it
        handle.succeed()
        return Fibonacci.Result()

    def wait(self, handle: Any) -> Any:
        handle.publish_feedback(Fibonacci.Feedback(partial_sequence=[1]))
        while not handle.is_cancel_requested:
            time.sleep(0.01)  # noqa: TID251  # as users of rclpy do it
        handle.canceled()
        return Fibonacci.Result(sequence=orders.PART)

    def abort(self, handle: Any) -> Any:
        handle.abort()
        return Fibonacci.Result(sequence=orders.PART)

    def fail(self, handle: Any) -> Any:
        raise ValueError("no such arm")

    def be_stubborn(self, handle: Any) -> Any:
        self._released.clear()
        handle.publish_feedback(Fibonacci.Feedback(partial_sequence=[1]))
        self._released.wait(10)
        handle.succeed()
        return Fibonacci.Result(sequence=orders.PART)

    def end_deferred(self, handle: Any) -> Any:
        handle.canceled() if handle.is_cancel_requested else handle.succeed()
        return Fibonacci.Result(sequence=orders.PART)

    def forget(self, handle: Any) -> Any:
        return Fibonacci.Result(sequence=orders.PART)


def main() -> None:
    rclpy.init()
    server = Server()
    executor = MultiThreadedExecutor(6)
    executor.add_node(server.node)
    spinner = Thread(target=spin, args=(executor,), daemon=True)
    spinner.start()
    say("ready")
    for _ in told():
        pass
    leave(spinner, server.node)


if __name__ == "__main__":
    main()

"""A process with a server of Fibonacci actions, in the manner of rmw_cyclonedds_cpp.

The orders are those of `tests/ros2/stock/orders.py`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from tests.ros2.stock import orders
from tests.transports.cyclone import idl
from tests.transports.cyclone.node import Node, Until, qos
from tests.transports.cyclone.services import DEPTH, Server

EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = 2, 3, 4, 5, 6
ALL = "00" * 16


class Goal:
    """A goal that was accepted."""

    def __init__(self, goal_id: Any, order: int, stamp: Any) -> None:
        self.info = idl.GoalInfo(goal_id, stamp)
        self.order = order
        self.status = EXECUTING
        self.result: list[int] = []
        self.waiting: list[Callable[..., None]] = []

    @property
    def text(self) -> str:
        """The ID of the goal."""
        return bytes(self.info.goal_id.uuid).hex()


class ActionServer:
    """A server of one action; all public methods are commands."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._goals: dict[str, Goal] = {}
        self._offered: list[str] = []

    async def serve(self, action: str) -> None:
        """Serve an action."""
        topic = f"rt{action}/_action"
        self._feedback = self._node.write(
            f"{topic}/feedback", idl.FeedbackMessage, qos(depth=DEPTH)
        )
        status_qos = qos(depth=1, late=True)
        self._status = self._node.write(f"{topic}/status", idl.GoalStatusArray, status_qos)
        self._parts = [
            Server(self._node, action, "send_goal", self._accept),
            Server(self._node, action, "get_result", self._give_result),
            Server(self._node, action, "cancel_goal", self._cancel),
        ]

    async def offered(self) -> list[str]:
        """Return the goals that were offered, in order."""
        return self._offered

    def _accept(self, request: Any, answer: Callable[..., None]) -> None:
        stamp = idl.Time(*divmod(time.time_ns(), 10**9))
        goal = Goal(request.goal_id, request.goal.order, stamp)
        self._offered.append(goal.text)
        is_accepted = goal.order >= 0 and goal.text not in self._goals
        answer(is_accepted, stamp)
        if is_accepted:
            self._goals[goal.text] = goal
            self._node.start(self._execute(goal))

    def _give_result(self, request: Any, answer: Callable[..., None]) -> None:
        goal = self._goals.get(bytes(request.goal_id.uuid).hex())
        if goal is None:
            return  # it was sent before this server was found: another one has it
        if goal.status > CANCELING:
            answer(goal.status, idl.Result(goal.result))
        else:
            goal.waiting.append(answer)

    def _cancel(self, request: Any, answer: Callable[..., None]) -> None:
        wanted = bytes(request.goal_info.goal_id.uuid).hex()
        active = [goal for goal in self._goals.values() if goal.status == EXECUTING]
        canceled = [goal for goal in active if wanted in (goal.text, ALL)]
        for goal in canceled:
            goal.status = CANCELING
        answer(0 if canceled else 1, [goal.info for goal in canceled])
        self._tell_statuses()

    async def _execute(self, goal: Goal) -> None:
        self._tell_statuses()
        if goal.order <= orders.MOST:
            sequence = [0, 1]
            for _ in range(1, goal.order):
                sequence.append(sequence[-1] + sequence[-2])
                self._tell_feedback(goal, sequence)
            self._end(goal, SUCCEEDED, sequence)
        elif goal.order == orders.ABORTS:
            self._end(goal, ABORTED, orders.PART)
        else:
            self._tell_feedback(goal, [1])
            await Until(lambda: goal.status == CANCELING)
            self._end(goal, CANCELED, orders.PART)

    def _end(self, goal: Goal, status: int, result: list[int]) -> None:
        goal.status, goal.result = status, result
        self._tell_statuses()
        for answer in goal.waiting:
            answer(status, idl.Result(result))

    def _tell_feedback(self, goal: Goal, sequence: list[int]) -> None:
        self._feedback.write(idl.FeedbackMessage(goal.info.goal_id, idl.Feedback(sequence)))

    def _tell_statuses(self) -> None:
        goals = list(self._goals.values())[-DEPTH:]
        self._status.write(
            idl.GoalStatusArray([idl.GoalStatus(goal.info, goal.status) for goal in goals])
        )


def main() -> None:
    """Run the process."""
    node = Node()
    node.run(ActionServer(node))


if __name__ == "__main__":
    main()

"""A stock client of rclpy, and raw services and topics beside it.

Only the thread that spins calls rclpy: rclpy 9.1.2 may lose an answer that arrives while another
thread is still sending.
"""

from __future__ import annotations

from collections.abc import Coroutine
from threading import Event, Thread
from time import perf_counter
from typing import Any

import numpy
import rclpy
from action_msgs.msg import GoalStatusArray
from action_msgs.srv import CancelGoal
from arduinobot_msgs.action import Fibonacci
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Log
from rclpy.action import ActionClient
from rclpy.action.graph import (
    get_action_client_names_and_types_by_node,
    get_action_names_and_types,
    get_action_server_names_and_types_by_node,
)
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from test_msgs.action import Fibonacci as OtherFibonacci
from type_description_interfaces.srv import GetTypeDescription
from unique_identifier_msgs.msg import UUID

from tests.ros2.stock.telling import leave, say, spin, told

PATIENCE = 15.0


def uuid_of(text: str) -> UUID:
    return UUID(uuid=numpy.frombuffer(bytes.fromhex(text), dtype=numpy.uint8))


def text_of(message: Any) -> str:
    return bytes(message.uuid).hex()


def nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


class Client:
    def __init__(self, name: str) -> None:
        self.node = rclpy.create_node(name)
        self._clients: dict[Any, Any] = {}
        self._handles: dict[str, Any] = {}
        self._results: dict[str, Any] = {}
        self._feedback: dict[str, list[list[int]]] = {}
        self._statuses: dict[str, list[list[Any]]] = {}
        self._log: list[list[str]] = []
        self.node.create_subscription(Log, "/rosout", self._take_log, 100)

    def _take_log(self, message: Log) -> None:
        self._log.append([message.name, message.msg])

    def _action_client(self, action: str, *, is_watched: bool = True) -> ActionClient:
        client = self._clients.get(action)
        if client is None:
            client = self._clients[action] = ActionClient(self.node, Fibonacci, action)
            if is_watched:
                self.watch_statuses(action)
            assert client.wait_for_server(timeout_sec=PATIENCE)
        return client

    def watch_statuses(self, action: str) -> None:
        seen = self._statuses.setdefault(action, [])

        def take(message: GoalStatusArray) -> None:
            seen.append([[text_of(s.goal_info.goal_id), s.status] for s in message.status_list])

        profile = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(GoalStatusArray, f"{action}/_action/status", take, profile)

    async def _call(self, kind: Any, name: str, request: Any) -> Any:
        client = self._clients.get(name)
        if client is None:
            client = self._clients[name] = self.node.create_client(kind, name)
            assert client.wait_for_service(timeout_sec=PATIENCE)
        return await client.call_async(request)

    # Commands

    async def ready(self, action: str) -> bool:
        return bool(self._action_client(action).server_is_ready())

    async def send(self, action: str, order: int, goal_id: str = "") -> dict[str, Any]:
        client = self._action_client(action)
        feedback: list[list[int]] = []
        handle = await client.send_goal_async(
            Fibonacci.Goal(order=order),
            feedback_callback=lambda m: feedback.append(list(m.feedback.partial_sequence)),
            goal_uuid=uuid_of(goal_id) if goal_id else None,
        )
        goal_id = text_of(handle.goal_id)
        if handle.accepted:
            self._handles[goal_id] = handle
            self._feedback[goal_id] = feedback
        stamp = nanoseconds(handle.stamp)
        return {"goal": goal_id, "accepted": handle.accepted, "stamp": stamp}

    async def publisher_hashes(self, topic: str) -> list[str]:
        return [str(one.topic_type_hash) for one in self.node.get_publishers_info_by_topic(topic)]

    async def type_description(self, node: str, type_name: str, type_hash: str) -> dict[str, Any]:
        request = GetTypeDescription.Request(type_name=type_name, type_hash=type_hash)
        answer = await self._call(GetTypeDescription, f"{node}/get_type_description", request)
        described = answer.type_description
        return {
            "successful": answer.successful,
            "reason": answer.failure_reason,
            "type_name": described.type_description.type_name,
            "types": [one.type_name for one in described.referenced_type_descriptions],
        }

    async def send_many(self, action: str, orders: list[int]) -> list[dict[str, Any]]:
        client = self._action_client(action)
        futures = [client.send_goal_async(Fibonacci.Goal(order=order)) for order in orders]
        handles = [await future for future in futures]
        results = [handle.get_result_async() for handle in handles if handle.accepted]
        answers = [await result for result in results]
        return [{"status": a.status, "sequence": list(a.result.sequence)} for a in answers]

    async def one_by_one(self, action: str, count: int) -> float:
        """Run so many short goals one after another, and return the seconds of each."""
        client = self._action_client(action, is_watched=False)
        began = perf_counter()
        for _ in range(count):
            handle = await client.send_goal_async(Fibonacci.Goal(order=1))
            answer = await handle.get_result_async()
            assert list(answer.result.sequence) == [0, 1]
        return (perf_counter() - began) / count

    async def request_result(self, goal: str) -> None:
        """Request a result, for which `result` will wait."""
        self._results[goal] = self._handles[goal].get_result_async()

    async def result(self, goal: str) -> dict[str, Any]:
        if goal not in self._results:
            await self.request_result(goal)
        answer = await self._results.pop(goal)
        return {"status": answer.status, "sequence": list(answer.result.sequence)}

    async def handle_status(self, goal: str) -> int:
        return int(self._handles[goal].status)

    async def feedback(self, goal: str) -> list[list[int]]:
        return self._feedback[goal]

    async def cancel(self, goal: str) -> dict[str, Any]:
        return self._canceled(await self._handles[goal].cancel_goal_async())

    async def raw_cancel(self, action: str, goal: str = "00" * 16, stamp: int = 0) -> Any:
        request = CancelGoal.Request()
        request.goal_info.goal_id = uuid_of(goal)
        request.goal_info.stamp.sec, request.goal_info.stamp.nanosec = divmod(stamp, 10**9)
        return self._canceled(
            await self._call(CancelGoal, f"{action}/_action/cancel_goal", request)
        )

    def _canceled(self, response: Any) -> dict[str, Any]:
        goals = sorted(text_of(info.goal_id) for info in response.goals_canceling)
        return {"code": response.return_code, "goals": goals}

    async def raw_result(self, action: str, goal: str) -> dict[str, Any]:
        kind = Fibonacci.Impl.GetResultService
        request = kind.Request(goal_id=uuid_of(goal))
        answer = await self._call(kind, f"{action}/_action/get_result", request)
        return {"status": answer.status, "sequence": list(answer.result.sequence)}

    async def statuses(self, action: str) -> list[list[Any]]:
        return self._statuses[action]

    async def watch_anew(self, action: str) -> None:
        """Let `statuses` begin anew, with a new subscription."""
        self._statuses[action] = []
        self.watch_statuses(action)

    async def log(self) -> list[list[str]]:
        return self._log

    async def change_state(self, node: str, transition: int) -> bool:
        """Let a lifecycle node change its state; return whether it has."""
        request = ChangeState.Request()
        request.transition.id = transition
        answer = await self._call(ChangeState, f"{node}/change_state", request)
        return bool(answer.success)

    async def graph(self) -> Any:
        return get_action_names_and_types(self.node)

    async def servers_of(self, node: str, namespace: str = "/") -> Any:
        return get_action_server_names_and_types_by_node(self.node, node, namespace)

    async def clients_of(self, node: str, namespace: str = "/") -> Any:
        return get_action_client_names_and_types_by_node(self.node, node, namespace)

    async def topics(self) -> list[str]:
        return [name for name, _ in self.node.get_topic_names_and_types()]

    async def profiles(self, topic: str) -> list[list[str]]:
        """Return the quality of service of a topic's publishers."""
        found = self.node.get_publishers_info_by_topic(topic)
        return [
            [one.qos_profile.reliability.name, one.qos_profile.durability.name] for one in found
        ]

    async def send_other_type(self, action: str) -> bool:
        """Send a goal of another type under the same name; return whether it has a server."""
        client = ActionClient(self.node, OtherFibonacci, action)
        self._clients[object()] = client
        client.send_goal_async(OtherFibonacci.Goal(order=3))
        return bool(client.server_is_ready())


def main() -> None:
    rclpy.init()
    client = Client("stock_client")
    executor = SingleThreadedExecutor()
    executor.add_node(client.node)
    spinner = Thread(target=spin, args=(executor,), daemon=True)
    spinner.start()
    say("ready")
    for order in told():
        done = Event()
        answers: list[Any] = []

        async def obey(command: Coroutine[Any, Any, Any], done: Event, answers: list[Any]) -> None:
            try:
                answers.append({"answer": await command})
            except Exception as exc:
                answers.append({"error": repr(exc)})
            done.set()

        executor.create_task(obey(getattr(client, order.pop("do"))(**order), done, answers))
        done.wait(PATIENCE)
        say(answers[0] if answers else {"error": f"no answer to {order}"})
    leave(spinner, client.node)


if __name__ == "__main__":
    main()

"""A process with a client of Fibonacci actions, in the manner of rmw_cyclonedds_cpp."""

from __future__ import annotations

import time
import uuid
from typing import Any

from tests.transports.cyclone import idl
from tests.transports.cyclone.node import Node, Until, qos, writers_of
from tests.transports.cyclone.services import DEPTH, PARTS, Client


def uuid_of(goal: str) -> Any:
    return idl.Uuid(list(bytes.fromhex(goal)))


def text_of(goal_id: Any) -> str:
    return bytes(goal_id.uuid).hex()


def info(goal: str) -> Any:
    return idl.GoalInfo(uuid_of(goal), idl.Time(0, 0))


class ActionClient:
    """A client of one action; all public methods are commands."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._feedback: dict[str, list[list[int]]] = {}
        self._statuses: list[list[list[Any]]] = []

    async def connect(self, action: str) -> None:
        """Wait for the server of an action."""
        self._parts = {part: Client(self._node, action, part) for part in PARTS}
        topic, settings = f"rt{action}/_action", qos(depth=1, late=True)
        self._heard = self._node.read(
            f"{topic}/feedback", idl.FeedbackMessage, self._take_feedback, qos(depth=DEPTH)
        )
        self._node.read(f"{topic}/status", idl.GoalStatusArray, self._take_status, settings)

    async def servers(self) -> int:
        """Return the number of servers that have all parts of the action."""
        found = [part.servers for part in self._parts.values()]
        return min(*found, writers_of(self._heard))

    async def send(self, order: int) -> dict[str, Any]:
        """Send a goal."""
        goal = uuid.uuid4().hex
        self._feedback[goal] = []
        answer = await self._parts["send_goal"].call(uuid_of(goal), idl.Goal(order))
        return {"goal": goal, "accepted": answer.accepted}

    async def result(self, goal: str) -> dict[str, Any]:
        """Wait for the result of a goal."""
        answer = await self._parts["get_result"].call(uuid_of(goal))
        return {"status": answer.status, "sequence": list(answer.result.sequence)}

    async def cancel(self, goal: str) -> dict[str, Any]:
        """Ask to cancel a goal; one of zeros means all."""
        answer = await self._parts["cancel_goal"].call(info(goal))
        goals = sorted(text_of(each.goal_id) for each in answer.goals_canceling)
        return {"code": answer.return_code, "goals": goals}

    async def feedback(self, goal: str, count: int) -> list[list[int]]:
        """Wait for so many messages of feedback."""
        await Until(lambda: len(self._feedback[goal]) >= count)
        return self._feedback[goal]

    async def status(self, goal: str, status: int) -> list[int]:
        """Wait for a status of a goal; return all that it had."""

        def seen() -> list[int]:
            return [now for each in self._statuses for at, now in each if at == goal]

        await Until(lambda: status in seen())
        return seen()

    async def many(self, orders: list[int]) -> list[dict[str, Any]]:
        """Send goals at once, and wait for all results."""
        send, goals = self._parts["send_goal"], [uuid.uuid4().hex for _ in orders]
        calls = [
            send.send(uuid_of(goal), idl.Goal(order))
            for goal, order in zip(goals, orders, strict=True)
        ]
        await Until(lambda: all(send.answers[call] for call in calls))
        get = self._parts["get_result"]
        calls = [get.send(uuid_of(goal)) for goal in goals]
        await Until(lambda: all(get.answers[call] for call in calls))
        answers = [get.answers[call][0] for call in calls]
        return [{"status": a.status, "sequence": list(a.result.sequence)} for a in answers]

    async def one_by_one(self, count: int, order: int) -> list[float]:
        """Run goals one after the other; return the seconds of each."""
        times = []
        for _ in range(count):
            begun = time.perf_counter()
            outcome = await self.result((await self.send(order))["goal"])
            assert outcome["status"] == 4, outcome
            times.append(time.perf_counter() - begun)
        return times

    async def repeated(self) -> int:
        """Return how many answers have come a second time."""
        return sum(
            len(answers) - 1
            for part in self._parts.values()
            for answers in part.answers.values()
            if answers
        )

    def _take_feedback(self, message: Any) -> None:
        found = self._feedback.get(text_of(message.goal_id))
        if found is not None:
            found.append(list(message.feedback.partial_sequence))

    def _take_status(self, message: Any) -> None:
        self._statuses.append(
            [[text_of(s.goal_info.goal_id), s.status] for s in message.status_list]
        )


def main() -> None:
    """Run the process."""
    node = Node()
    node.run(ActionClient(node))


if __name__ == "__main__":
    main()

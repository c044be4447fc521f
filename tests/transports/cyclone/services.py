"""Both ends of services and actions in the manner of rmw_cyclonedds_cpp.

A request has a header with an ID of its client and a number ahead of the message, and the reply the
same header. Replies go to the clients of all, and each takes its own.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable
from typing import Any

from tests.transports.cyclone import idl
from tests.transports.cyclone.node import Node, Until, qos, readers_of, writers_of

DEPTH = 10
CLIENT = 8
PARTS = {
    "send_goal": (idl.SendGoalRequest, idl.SendGoalResponse),
    "get_result": (idl.GetResultRequest, idl.GetResultResponse),
    "cancel_goal": (idl.CancelRequest, idl.CancelResponse),
}


def _service_qos() -> Any:
    """Return what rmw_cyclonedds_cpp asks for; both ends of a service have the same ID."""
    data = f"serviceid= {secrets.token_hex(8)};"
    return qos(depth=DEPTH, data=data.encode())


class Client:
    """A client of a service of an action."""

    def __init__(self, node: Node, action: str, part: str) -> None:
        request, response = PARTS[part]
        name, settings = f"{action}/_action/{part}", _service_qos()
        self._request = request
        self._id = list(secrets.token_bytes(CLIENT))
        self._calls = 0
        self.answers: dict[int, list[Any]] = {}
        """All answers to each call."""
        self.reader = node.read(f"rr{name}Reply", response, self._take, settings)
        self.writer = node.write(f"rq{name}Request", request, settings)

    @property
    def servers(self) -> int:
        """The number of servers that can be called, as rmw_cyclonedds_cpp sees it."""
        return min(readers_of(self.writer), writers_of(self.reader))

    def send(self, *fields: Any) -> int:
        """Send a request; return its number."""
        self._calls += 1
        self.answers[self._calls] = []
        self.writer.write(self._request(self._id, self._calls, *fields))
        return self._calls

    async def call(self, *fields: Any) -> Any:
        """Send a request, and return the answer."""
        answers = self.answers[self.send(*fields)]
        await Until(lambda: answers)
        return answers[0]

    def _take(self, answer: Any) -> None:
        if list(answer.client) == self._id:
            self.answers[answer.number].append(answer)


class Server:
    """A server of a service of an action: `take` gets a request, and what answers it."""

    def __init__(
        self,
        node: Node,
        action: str,
        part: str,
        take: Callable[[Any, Callable[..., None]], None],
    ) -> None:
        request, self._response = PARTS[part]
        name, settings = f"{action}/_action/{part}", _service_qos()
        self._handle = take
        self._writer = node.write(f"rr{name}Reply", self._response, settings)
        self._reader = node.read(f"rq{name}Request", request, self._take, settings)

    def _take(self, request: Any) -> None:
        def answer(*fields: Any) -> None:
            self._writer.write(self._response(request.client, request.number, *fields))

        self._handle(request, answer)

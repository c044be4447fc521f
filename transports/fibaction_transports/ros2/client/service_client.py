"""A client of one service of ROS, with the retry of a call.

Full queues of ROS drop requests, without an error. So only a few calls wait for an answer at a
time, and a request is sent again if its answer does not arrive in time, or as soon as the
middleware tells that there will be none.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import anyio
from anyio import current_time

from fibaction.border.abc import Notifier
from fibaction.words.errors import ConnectionLost
from fibaction_transports.ros2.node.ros_node import RosNode
from fibaction_transports.ros2.qos import EndQos

AT_ONCE = 8
"""Calls that may wait for their first answer at a time. The queues of rclpy and rclcpp hold 10."""
FIRST_TIMEOUT, LONGEST_TIMEOUT = 1.0, 30.0
"""Seconds until a request is sent again: the first time, and at most. The timeout doubles with each
retry, because a server may just be slow to decide."""

LISTED = 0.3
"""Seconds for the answer to arrive after something else has shown that the request has. Servers of
Fast DDS drop an answer after 0.1 s if they have not found the reader of the client by then."""


FIRST_PAUSE, LONGEST_PAUSE = 0.02, 1.0
"""Seconds until a request is sent again that the server has not taken: the first time, and at most.
"""


class ServiceCall:
    """One call of a service: a request, sent once or several times, and its latest answer."""

    def __init__(
        self, client: ServiceClient, request: Any, after: Callable[[], None] = lambda: None
    ) -> None:
        """`after` is called when the request has been sent for the first time."""
        self.tries = 0
        self.response: Any = None
        self._client = client
        self._request = request
        self._after = after
        self._numbers: list[int] = []
        self._news = Notifier()
        self._timeout = FIRST_TIMEOUT
        self._pause = FIRST_PAUSE
        self._is_due = False
        self._scope = anyio.CancelScope()
        self._error: ConnectionLost | None = None

    def __enter__(self) -> ServiceCall:
        self._client.calls.add(self)
        return self

    def __exit__(self, *_: object) -> None:
        self._client.calls.discard(self)
        for number in self._numbers:
            self._client.forget(number)

    async def attempt(self) -> bool:
        """Send the request, for the first time or again, and return whether an answer came in time.

        Raises:
            ConnectionLost: There will be no answer.
        """
        if self.tries:
            return await self._try()
        async with self._client.turns:
            return await self._try()

    async def _try(self) -> bool:
        self._raise_error()
        self._is_due = False
        self.tries += 1
        self._numbers.append(self._client.send(self._request, self))
        if self.tries == 1:
            self._after()
        timeout, self._timeout = self._timeout, min(2 * self._timeout, LONGEST_TIMEOUT)
        return await self.wait(timeout)

    async def wait(self, seconds: float) -> bool:
        """Wait for an answer without a retry, and return whether there is one."""
        with anyio.move_on_after(seconds) as self._scope:
            while self.response is None and not self._is_due:
                self._raise_error()
                await self._news.wait()
        return self.response is not None

    def hasten(self) -> None:
        """Wait no longer than `LISTED` seconds for the answer, because the request has arrived."""
        self._scope.deadline = min(self._scope.deadline, current_time() + LISTED)

    def note_unanswered(self) -> None:
        """Send the request again after a pause: it has been lost."""
        self._scope.deadline = min(self._scope.deadline, current_time() + self._pause)
        self._pause = min(2 * self._pause, LONGEST_PAUSE)

    def set_response(self, response: Any) -> None:
        """Store an answer. After a retry there may be several; the last one counts."""
        self.response = response
        self._news.notify()

    def resume(self) -> None:
        """Send the request again now: it may have been lost."""
        self._is_due, self._timeout = True, FIRST_TIMEOUT
        self._news.notify()

    def fail(self, error: ConnectionLost) -> None:
        """End the call with an error."""
        self._error = error
        self._news.notify()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise ConnectionLost(str(self._error))


class ServiceClient:
    """A client of one service."""

    def __init__(self, ros: RosNode, service: str, service_type: Any, qos: EndQos) -> None:
        """Make the client.

        Raises:
            TransportError: ROS does not allow it.
        """
        self.caller = ros.caller(
            service, service_type, qos, self._take, take_unanswered=self._take_unanswered
        )
        self.turns = anyio.Semaphore(AT_ONCE, fast_acquire=True)
        """Limits the calls that wait for their first answer."""
        self.calls: set[ServiceCall] = set()
        """The calls that wait for their answers, or for their turn."""
        self._open: dict[int, ServiceCall] = {}

    async def call(self, request: Any) -> Any:
        """Send a request until it is answered, and return the answer.

        Raises:
            ConnectionLost: There will be no answer.
        """
        with ServiceCall(self, request) as call:
            while not await call.attempt():
                pass
            return call.response

    def send(self, request: Any, call: ServiceCall) -> int:
        """Send a request once, and return its number.

        Raises:
            ConnectionLost: ROS cannot send any more.
        """
        number = self.caller.send(request)
        self._open[number] = call
        return number

    def forget(self, number: int) -> None:
        """Ignore the answer to this request from now on."""
        self._open.pop(number, None)
        self.caller.forget(number)

    def resume(self) -> None:
        """Send all requests again that wait for their answers."""
        for call in self.calls:
            call.resume()

    def fail(self, error: ConnectionLost) -> None:
        """End all calls with an error."""
        for call in self.calls:
            call.fail(error)

    def _take(self, number: int, response: Any) -> None:
        call = self._open.get(number)
        if call is not None:
            call.set_response(response)

    def _take_unanswered(self, number: int) -> None:
        with suppress(KeyError):  # it was answered meanwhile
            self._open[number].note_unanswered()

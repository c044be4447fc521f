"""Services: a client that sends each request once, and a server."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any, Final, Generic, NamedTuple, TypeAlias, TypeVar

import anyio

from fibaction.border.abc import Notifier
from fibaction.words.errors import ConnectionLost, ServerNotFound
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.messaging.forms import MessageForm
from fibaction_transports.ros2.node.ros_node import CalledType, RosNode

ACQUAINTED: Final = 0.3
"""Seconds for a server to find a new client, where nothing tells that it has. Servers of Fast DDS
drop the answer to a client that they have not found within 0.1 s."""
GONE_PAUSE: Final = 0.5
"""Seconds between two looks whether the server that was asked is still there."""
AT_ONCE: Final = 8
"""Requests of one client that may wait for their answers: the queues of rclpy and rclcpp hold 10.
"""

RequestT = TypeVar("RequestT")
ResponseT = TypeVar("ResponseT")
ServiceFunction: TypeAlias = Callable[[Any], Any | Awaitable[Any]]
"""A function that takes a request and returns the answer, or a dict with its fields."""


class Service(Generic[RequestT, ResponseT]):
    """A service with the classes of its messages, as `fibaction gen` writes it."""

    def __init__(self, type_name: str, request: type[RequestT], response: type[ResponseT]) -> None:
        self.type_name = type_name
        """The ROS 2 type, for example `std_srvs/srv/Trigger`."""
        self.request = request
        self.response = response


class _Answer(NamedTuple):
    """The outcome of a request."""

    response: Any
    error: Exception | None = None


class CalledService:
    """A client of one service."""

    def __init__(
        self, ros: RosNode, service: str, type_: str | Service[Any, Any], called: CalledType
    ) -> None:
        self._ros = ros
        self._service = service
        self._type_name = type_ if isinstance(type_, str) else type_.type_name
        self._request, self._response = forms_of(type_, called)
        self._news = Notifier()
        self._turns = anyio.Semaphore(AT_ONCE, fast_acquire=True)
        self._is_new = not ros.confirms_callers
        self._answers: dict[int, _Answer | None] = {}
        """The requests that are waited for, with what has become of them."""
        self._part = ros.caller(
            service,
            called.service,
            qos.services(),
            lambda number, response: self._settle(number, _Answer(response)),
            self._fail_all,
            lambda number: self._settle(number, _Answer(None, _unanswered(service))),
        )
        self._forget = ros.on_loss(self._fail_all)
        self._users = 0

    @property
    def is_idle(self) -> bool:
        """True if no call is under way."""
        return not self._users

    def close(self) -> None:
        """Remove the client, which is idle, from the graph."""
        self._forget()
        self._ros.remove(self._part)

    def _settle(self, number: int, answer: _Answer) -> None:
        if number in self._answers:  # else nobody waits for it any more
            self._answers[number] = answer
            self._news.notify()

    def _fail_all(self, error: Exception) -> None:
        for number in self._answers:
            self._answers[number] = _Answer(None, error)
        self._news.notify()

    async def call(self, request: Any, timeout: float | None) -> Any:
        """Wait for a server, send a request once, and return the answer.

        Raises:
            ValueError: The request does not fit its type.
            TimeoutError: There was no server, or no answer, in time; the text says which.
            ConnectionLost: The node, or the server, has gone.
            ProtocolError: The answer is not a value of the class.
        """
        try:
            message = self._request.to_ros({} if request is None else request)
        except ValueError as exc:
            raise ValueError(f"{self._service}: {exc}") from exc
        self._users += 1
        try:
            return await self._call(message, timeout)
        finally:
            self._users -= 1

    async def _call(self, message: Any, timeout: float | None) -> Any:
        missing = "nothing was asked"
        if not self._turns.value:
            missing = f"its last {AT_ONCE} requests have no answers"
        with anyio.move_on_after(timeout):
            async with self._turns:
                missing = "there is no server"
                await self._ros.until(self._part.is_available)
                if self._is_new:
                    await anyio.sleep(ACQUAINTED)
                    self._is_new = False
                asked = self._servers()
                number = self._part.send(message)
                missing = "the server has not answered"
                return await self._answer(number, asked)
        raise TimeoutError(f"{self._service}: {missing} in {timeout:g} s{self._other_type()}")

    def _other_type(self) -> str:
        """Return the type of the server that is there, if it is not the one that is called."""
        found = dict(self._ros.services()).get(self._service, self._type_name)
        return "" if found == self._type_name else f": it is a service of {found}"

    def _servers(self) -> set[bytes]:
        return {end.gid for end in self._ros.request_readers(self._service)}

    async def _answer(self, number: int, asked: set[bytes]) -> Any:
        self._answers[number] = None
        try:
            while (answer := self._answers[number]) is None:
                with anyio.move_on_after(GONE_PAUSE):
                    await self._news.wait()
                    continue
                if asked and asked.isdisjoint(self._servers()):
                    await self._ros.last_words()
                    gone = _Answer(None, _unanswered(self._service))
                    self._answers[number] = self._answers[number] or gone
        finally:
            del self._answers[number]
            self._part.forget(number)
        if answer.error is not None:
            raise ConnectionLost(f"{self._service}: {answer.error}") from answer.error
        return self._response.from_ros(answer.response)


def forms_of(type_: str | Service[Any, Any], called: CalledType) -> tuple[MessageForm, MessageForm]:
    """Return the forms of the requests and of the answers of a service.

    Raises:
        TypeError: A class does not have the fields of the type.
    """
    if isinstance(type_, str):
        given: tuple[Any, Any] = called.request.text, called.response.text
    else:
        given = type_.request, type_.response
    return MessageForm(called.request, given[0]), MessageForm(called.response, given[1])


def _unanswered(service: str) -> Exception:
    return ServerNotFound(f"the server of {service} has gone, or has thrown the request away")

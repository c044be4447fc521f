"""`open_node`: one node in a graph of ROS, for actions, topics and services alike."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Generator
from contextlib import AbstractContextManager, aclosing, asynccontextmanager, contextmanager
from inspect import isawaitable
from typing import Any, Final, TypeVar, overload

import anyio
from anyio.abc import TaskGroup

from fibaction.border.abc import Notifier
from fibaction.border.event_loop import Background
from fibaction.border.urls import transport_for
from fibaction.types.ros_messages import plain_value
from fibaction.words.errors import ConnectionLost, InvalidURL
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.client.endpoint import GraphLooks
from fibaction_transports.ros2.messaging.forms import MessageForm, type_name_of
from fibaction_transports.ros2.messaging.parameters import OwnParameters, RemoteParameters
from fibaction_transports.ros2.messaging.services import (
    CalledService,
    RequestT,
    ResponseT,
    Service,
    ServiceFunction,
    forms_of,
)
from fibaction_transports.ros2.messaging.shared import PartsOfBlock
from fibaction_transports.ros2.messaging.topics import (
    NewestMessages,
    Publisher,
    Subscription,
    Wanted,
)
from fibaction_transports.ros2.messaging.transforms import Transform, TransformReader
from fibaction_transports.ros2.node.parts import GraphView
from fibaction_transports.ros2.node.ros_node import RosAdapter, RosNode
from fibaction_transports.ros2.qos import EndQos, suiting
from fibaction_transports.ros2.ros_transport import RosTransport
from fibaction_transports.ros2.server.service_server import ServiceServers
from fibaction_transports.ros2.settings import RosSettings

T = TypeVar("T")

MOST_CALLERS: Final = 64
"""Clients of services that are kept for the next call; then those give way that are idle."""


class Node(RosTransport):
    """A node in a graph of ROS: it subscribes and publishes, calls and serves services, and as an
    address for `serve` and `connect` it serves and calls actions.

    Names of topics and services are expanded and remapped as those of actions.
    """

    def __init__(self, ros: RosNode, settings: RosSettings, tasks: TaskGroup, scheme: str) -> None:
        """Use an open node; `open_node` does it."""
        super().__init__(_OpenNode(ros), settings)
        self.scheme = scheme
        self._ros = ros
        self._transforms: TransformReader | None = None
        self._looks = GraphLooks(ros, settings.discovery_timeout)
        self._newest = NewestMessages(self.subscribe, tasks)
        self._callers: dict[tuple[str, str | Service[Any, Any]], CalledService] = {}
        self._tasks = tasks

    @property
    def name(self) -> str:
        """The full name, for example `/robot/arm`."""
        return self._ros.full_name

    # Topics

    @overload
    def subscribe(
        self, topic: str, type_: type[T], *, qos: str | EndQos = "", depth: int | None = None
    ) -> Subscription[T]: ...
    @overload
    def subscribe(
        self, topic: str, type_: str, *, qos: str | EndQos = "", depth: int | None = None
    ) -> Subscription[Any]: ...
    def subscribe(
        self,
        topic: str,
        type_: str | type[Any],
        *,
        qos: str | EndQos = "",
        depth: int | None = None,
    ) -> Subscription[Any]:
        """Subscribe to a topic, until the subscription is closed or the node.

        Args:
            topic: The name.
            type_: The type, such as `nav_msgs/msg/Odometry`; or a class that is made from it, for
                typed messages.
            qos: `sensor_data` or another profile of ROS; words of ROS with commas: `reliable` or
                `best_effort`, `volatile` or `transient_local`, `keep_last` or `keep_all`; or all of
                it.
            depth: The messages that wait for a slow reader; then the oldest gives way. Without it,
                that of the profile, or 10.

        Raises:
            TransportError: The type is not known here, or ROS does not allow the name.
            ValueError: The quality of service is not one of ROS.
            TypeError: It is neither a text nor an `EndQos`.
            ConnectionLost: The node was closed, or cannot reach ROS any more.
        """
        return Subscription(*self._end(topic, type_, qos, depth))

    def topics(self) -> dict[str, str]:
        """Return the topics that are in the graph now, and the names of their types."""
        return dict(self._ros.topics())

    async def type_of(self, topic: str, *, timeout: float | None = None) -> str:
        """Wait until a topic is in the graph, and return the name of its type, which other methods
        know then: what has no file here is learned from the publishers, as far as they tell it.

        Raises:
            TimeoutError: No node has such a topic in the seconds of the timeout.
            TransportError: The type is not known here, and no publisher tells it.
        """
        found = await self.find_type(topic, timeout=timeout)
        await self._ros.learn_topic(self._ros.resolve(topic), found)
        self._ros.types.topic_type(found)
        return found

    async def find_type(self, topic: str, *, timeout: float | None = None) -> str:
        """Wait until a topic is in the graph, and return the name of its type, known here or not.

        Raises:
            TimeoutError: No node has such a topic in the seconds of the timeout.
        """
        name = self._ros.resolve(topic)
        with anyio.move_on_after(timeout):
            return await self._ros.until(lambda: self.topics().get(name, ""))
        raise TimeoutError(f"no node has had the topic {name} in {timeout:g} s")

    @overload
    async def next(
        self,
        topic: str,
        type_: type[T],
        *,
        qos: str | EndQos = "",
        timeout: float | None = None,
    ) -> T: ...
    @overload
    async def next(
        self, topic: str, type_: str, *, qos: str | EndQos = "", timeout: float | None = None
    ) -> Any: ...
    async def next(
        self,
        topic: str,
        type_: str | type[Any],
        *,
        qos: str | EndQos = "",
        timeout: float | None = None,
    ) -> Any:
        """Return the next message that arrives on a topic; with `qos="transient_local"`, the newest
        one at once that its publishers keep.

        All calls share one subscription, which stays open for some seconds after the last one. The
        errors are those of `subscribe` and of `Subscription.next`.
        """
        return await self._newest.next(self._wanted(topic, type_, qos), timeout)

    @overload
    def latest(self, topic: str, type_: type[T], *, qos: str | EndQos = "") -> T | None: ...
    @overload
    def latest(self, topic: str, type_: str, *, qos: str | EndQos = "") -> Any | None: ...
    def latest(self, topic: str, type_: str | type[Any], *, qos: str | EndQos = "") -> Any | None:
        """Return the newest message of a topic, which is read from the first call on; None if none
        has arrived yet. The errors are those of `subscribe`.
        """
        return self._newest.latest(self._wanted(topic, type_, qos))

    def _wanted(self, topic: str, type_: str | type[Any], given: str | EndQos) -> Wanted:
        type_name_of(type_)
        return self._ros.resolve(topic), type_, qos.of_topic(given)

    async def follow(
        self, topic: str, *, qos: str = "", depth: int = 10, timeout: float | None = None
    ) -> Subscription[Any]:
        """Wait until a topic is in the graph, and subscribe as `ros2 topic echo` does: to the type
        of its publishers, and with a quality of service that suits all of them unless one is given.
        The errors are those of `type_of` and `subscribe`.
        """
        type_name = await self.type_of(topic, timeout=timeout)
        name = self._ros.resolve(topic)
        found = self._ros.publishers(name)
        if not found:  # a subscription may have been seen first
            found = await self.settled(lambda view: view.publishers(name))
        offers = [end.qos for end in found]
        return self.subscribe(topic, type_name, qos=qos or suiting(offers), depth=depth)

    async def settled(self, look: Callable[[GraphView], T]) -> T:
        """Return what is found in the graph once discovery is complete: see `GraphView`.

        Raises:
            ConnectionLost: The node was closed.
        """
        return await self._looks.settled(look)

    @overload
    def publisher(
        self, topic: str, type_: type[T], *, qos: str | EndQos = "", depth: int | None = None
    ) -> Publisher[T]: ...
    @overload
    def publisher(
        self, topic: str, type_: str, *, qos: str | EndQos = "", depth: int | None = None
    ) -> Publisher[Any]: ...
    def publisher(
        self,
        topic: str,
        type_: str | type[Any],
        *,
        qos: str | EndQos = "",
        depth: int | None = None,
    ) -> Publisher[Any]:
        """Announce a publisher of a topic; the arguments and errors are those of `subscribe`.

        With `qos="transient_local"`, the last `depth` messages are sent to readers that come later.
        """
        return Publisher(*self._end(topic, type_, qos, depth))

    def _end(
        self, topic: str, type_: str | type[Any], given: str | EndQos, depth: int | None
    ) -> Any:
        self._ros.raise_if_lost()
        found = self._ros.types.topic_type(type_name_of(type_))
        form = MessageForm(found.kind, type_)
        return self._ros, self._ros.resolve(topic), found, form, qos.of_topic(given, depth)

    async def transform(
        self, frame: str, target: str, *, at: float | None = None, timeout: float | None = None
    ) -> Transform:
        """Return the pose of a frame in another one, from `/tf` and `/tf_static`: for example, that
        of `"base_link"` in `"map"`. tf2 names the two the other way round.

        `at` is a time in seconds, as in the stamps of messages; without it, the newest time counts
        for which all frames between them are known. The call waits until the pose is known. The
        topics are read from the first call on. As with tf2, the timeout is by the clock of the
        node, which may be that of a simulation; all other timeouts are by that of the machine.

        Raises:
            TimeoutError: It was not known in the seconds of the timeout; the text says why.
            TransportError: `tf2_msgs/msg/TFMessage` is not known here.
        """
        if self._transforms is None:
            self._transforms = TransformReader(self._ros)
        return await self._transforms.look_up(frame, target, at, timeout)

    # Services, and parameters, which are services

    @overload
    def parameters(self) -> OwnParameters: ...
    @overload
    def parameters(self, node: str, *, timeout: float | None = None) -> RemoteParameters: ...
    def parameters(
        self, node: str = "", *, timeout: float | None = None
    ) -> OwnParameters | RemoteParameters:
        """Return the parameters of this node, to declare and to watch them; or those of another
        one, by its name: each call to it has this timeout, in seconds.
        """
        return RemoteParameters(self, node, timeout) if node else OwnParameters(self._ros)

    def full_name(self, name: str) -> str:
        """Return a name in the graph, as this node expands and remaps it.

        Raises:
            TransportError: ROS does not allow it.
        """
        return self._ros.resolve(name)

    @overload
    async def call(
        self,
        service: str,
        type_: Service[RequestT, ResponseT],
        request: RequestT | dict[str, Any] | None = None,
        *,
        timeout: float | None = None,
    ) -> ResponseT: ...
    @overload
    async def call(
        self, service: str, type_: str, request: Any = None, *, timeout: float | None = None
    ) -> Any: ...
    async def call(
        self,
        service: str,
        type_: str | Service[Any, Any],
        request: Any = None,
        *,
        timeout: float | None = None,
    ) -> Any:
        """Wait for a server of a service, send a request once, and return the answer.

        `type_` is the name of the type, or a service that `fibaction gen` has written, for typed
        messages. `request` is a message, or a dict with its fields; without it, all have their
        defaults.

        Raises:
            TransportError: The type is not known here, or ROS does not allow the name.
            ValueError: The request does not fit the type; the text names the field.
            TimeoutError: There was no server, or no answer, in the seconds of the timeout.
            ConnectionLost: The node, or the server, has gone.
            ProtocolError: The answer is not a value of the class that it is to have.
        """
        return await self._caller(self._ros.resolve(service), type_).call(request, timeout)

    def _caller(self, name: str, type_: str | Service[Any, Any]) -> CalledService:
        type_name = _service_type(type_)
        caller = self._callers.pop((name, type_), None)
        if caller is None:
            self._ros.raise_if_lost()
            for key in [key for key, one in self._callers.items() if one.is_idle]:
                if len(self._callers) >= MOST_CALLERS:
                    self._callers.pop(key).close()
            called = self._ros.types.called_type(type_name)
            caller = CalledService(self._ros, name, type_, called)
        self._callers[name, type_] = caller  # the last one, which gives way last
        return caller

    @overload
    def serve_service(
        self,
        service: str,
        type_: Service[RequestT, ResponseT],
        answer: Callable[[RequestT], Awaitable[ResponseT] | ResponseT | dict[str, Any] | None],
    ) -> AbstractContextManager[None]: ...
    @overload
    def serve_service(
        self, service: str, type_: str, answer: ServiceFunction
    ) -> AbstractContextManager[None]: ...
    @contextmanager
    def serve_service(
        self, service: str, type_: str | Service[Any, Any], answer: ServiceFunction
    ) -> Generator[None, None, None]:
        """Serve a service while the block is open.

        `answer` is a function, async or not, that takes the request, and returns the answer or a
        dict with its fields. If it raises, the answer has the defaults of ROS, and the log tells
        the error.

        Raises:
            TransportError: The type is not known here, or ROS does not allow the name.
        """
        self._ros.raise_if_lost()
        called = self._ros.types.called_type(_service_type(type_))
        requests, responses = forms_of(type_, called)

        async def answered(request: Any) -> Any:
            response = answer(requests.from_ros(request))
            if isawaitable(response):
                response = await response
            return responses.to_ros({} if response is None else response)

        name = self._ros.resolve(service)
        servers = ServiceServers(self._ros, name, qos.services(), self._tasks, Notifier())
        part = servers.serve(name, called.service, answered)
        try:
            yield
        finally:
            servers.close()
            self._ros.remove(part)


def _service_type(given: object) -> str:
    if isinstance(given, Service):
        return given.type_name
    if isinstance(given, str):
        return given
    raise TypeError(
        f"{given!r} is not a type of services: give it by its name, such as 'std_srvs/srv/Trigger',"
        " or a service that `fibaction gen` has written"
    )


class _OpenNode(RosAdapter):
    """The way to a graph through a node that is open already."""

    def __init__(self, ros: RosNode) -> None:
        self.types = ros.types
        self._ros = ros

    @asynccontextmanager
    async def open(self) -> AsyncGenerator[RosNode, None]:
        with PartsOfBlock(self._ros) as block:
            yield block


class NodeTransport(RosTransport):
    """A transport whose nodes are open to users, for more than actions."""

    @asynccontextmanager
    async def open_node(self) -> AsyncGenerator[Node, None]:
        """Open a node; see the function `open_node`."""
        async with self._adapter.open() as ros, Background() as tasks:
            try:
                yield Node(ros, self._settings, tasks, self.scheme)
            finally:
                ros.fail(ConnectionLost("the node was closed here"))


@asynccontextmanager
async def open_node(where: str | NodeTransport, **settings: Any) -> AsyncGenerator[Node, None]:
    """Open a node in a graph of ROS, for as long as the block lasts.

    `where` is a URL of `ros2://`, `dds://` or `zenoh://` with the name of the node, or a transport
    of these; `settings` are those of the transport.

        async with open_node("dds://drive_base") as node:
            command = node.publisher("/cmd_vel", "geometry_msgs/msg/Twist")
            async for odometry in node.subscribe("/odom", "nav_msgs/msg/Odometry"):
                await command.publish({"linear": {"x": 0.2}})

    Raises:
        InvalidURL: The URL is malformed, or is not one of ROS.
        TransportError: ROS does not allow such a node, or it cannot be made.
        TypeError: There is no such setting.
    """
    transport = transport_for(where, **settings)
    if not isinstance(transport, NodeTransport):
        raise InvalidURL(f"{where}: a node of ROS is at ros2://, dds:// or zenoh://")
    async with transport.open_node() as node:
        yield node


@asynccontextmanager
async def topic_values(
    where: str | NodeTransport,
    topic: str,
    *,
    qos: str = "",
    timeout: float | None = None,
    **settings: Any,
) -> AsyncGenerator[AsyncIterator[Any], None]:
    """Follow a topic of any type, for as long as the block lasts, with a node of its own: an
    iterator of its messages as plain values, as a page or a log shows them.

    They can be written as JSON, with bytes in base64. Only the newest message waits for a slow
    reader. The arguments and errors are those of `open_node` and `Node.follow`.
    """
    async with open_node(where, **settings) as node:
        with await node.follow(topic, qos=qos, depth=1, timeout=timeout) as messages:
            async with aclosing(plain_value(message) async for message in messages) as values:
                yield values

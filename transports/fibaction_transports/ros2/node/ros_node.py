"""A node of ROS, as the two halves of the transport use it; a middleware's adapter implements it.

Everything is called on the event loop, and the sinks are called there, too.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractAsyncContextManager, nullcontext
from typing import Any, Final, NamedTuple, TypeVar

import anyio

from fibaction.border.abc import Endpoint
from fibaction.words.errors import ConnectionLost
from fibaction_transports.ros2.convert.conversion import RosAction
from fibaction_transports.ros2.convert.message_types import MessageKind
from fibaction_transports.ros2.node.own_parameters import ParameterStore
from fibaction_transports.ros2.node.parts import (
    AnswerSink,
    EndInfo,
    ErrorSink,
    GraphView,
    LifeWatch,
    MessageSink,
    NodePart,
    RequestSink,
    ServiceCaller,
    ServiceProvider,
    TopicPublisher,
    TopicSubscription,
    UnansweredSink,
)
from fibaction_transports.ros2.qos import EndQos


class Links(NamedTuple):
    """The connections of a node to others."""

    facts: dict[str, Any]
    """Facts of a diagnosis."""
    trouble: str
    """A sentence that says why no other node can be there; empty if one may be."""


LOOK_PAUSE: Final = 0.02
"""Seconds between two looks at a graph that does not tell of its changes."""

LAST_WORDS: Final = 0.25
"""Seconds for messages to arrive that a server has sent before it left the graph."""

FoundT = TypeVar("FoundT")


class RosClock(ABC):
    """The clock of a node: the machine's, or that of a simulation (`use_sim_time`)."""

    era: int
    """Grows when the clock jumps back, and when it is exchanged for another one. Times of
    different eras cannot be compared."""

    @property
    @abstractmethod
    def is_the_machines(self) -> bool:
        """True if it is, and has always been, the clock of the machine."""

    @abstractmethod
    def now(self) -> int:
        """Return the time, in nanoseconds; 0 if the clock of a simulation has not said any yet."""


class TypeVersion(NamedTuple):
    """A type of messages, and the hash of its definition."""

    type_name: str
    type_hash: str
    service_hash: str = ""
    """The hash of its service, which some middlewares announce instead; empty for other types."""


class TopicType(NamedTuple):
    """A type of messages on topics, as a middleware knows it."""

    message: Any
    """The type that publishers and subscriptions are made with."""
    kind: MessageKind
    """Its fields, and what makes its messages."""


class CalledType(NamedTuple):
    """A type of services, as a middleware knows it."""

    service: Any
    """The type that clients and servers are made with."""
    request: MessageKind
    response: MessageKind


class EndpointInRos(Endpoint):
    """An endpoint of an action that is in a graph of ROS."""

    ros_action: RosAction
    """The type of the action, in the version that its server has."""


class RosTypes(ABC):
    """The types of messages that a middleware knows.

    Messages are objects with the fields of ROS, and types are called without arguments to make one
    with its defaults. The type of a service has its two messages as `Request` and `Response`.
    """

    GoalInfo: Callable[[], Any]
    """`action_msgs/msg/GoalInfo`."""
    Parameter: Callable[[], Any]
    """`rcl_interfaces/msg/Parameter`."""

    @abstractmethod
    def find(self, type_name: str, action: str = "") -> RosAction:
        """Find the type of an action by its name, for example
        `example_interfaces/action/Fibonacci`.

        `action` is the name of an action of this type, for errors.

        Raises:
            TransportError: There is no such type that can be used; the text says what to do.
        """

    def can_serve(self, action: RosAction) -> bool:
        """Return whether an action can be served with a type that may be of other `RosTypes`."""
        return False

    def find_to_follow(self, type_name: str, action: str = "") -> RosAction:
        """Find a type as `find` does, for a client. A middleware may follow goals of types that it
        does not know: then an error comes with the first goal that is sent.

        Raises:
            TransportError: As for `find`.
        """
        return self.find(type_name, action)

    @abstractmethod
    def topic_type(self, type_name: str) -> TopicType:
        """Find the type of messages by its name, for example `nav_msgs/msg/Odometry`.

        Raises:
            TransportError: There is no such type that can be used; the text says what to do.
        """

    @abstractmethod
    def called_type(self, type_name: str) -> CalledType:
        """Find the type of a service by its name, for example `std_srvs/srv/Trigger`.

        Raises:
            TransportError: As for `topic_type`.
        """

    @abstractmethod
    def texts(self, type_name: str) -> dict[str, str]:
        """Return the text of the `.action` file of a type, and those of the `.msg` files that it
        nests, by the types that they define.

        Raises:
            TransportError: As for `find`, or the type is known in part only.
        """

    def version(self, message_type: Any, service_type: Any = None) -> TypeVersion | None:
        """Return the version of a type of messages, which may be of a service; None if the
        middleware does not tell it.
        """
        return None

    @abstractmethod
    def uuid(self, goal_id: bytes) -> Any:
        """Return a goal ID as the value of the field `uuid` in messages."""

    @abstractmethod
    def decode(self, message: bytes, message_type: Any) -> Any:
        """Return a serialized message as an object.

        Raises:
            ProtocolError: It is not a message of this type.
        """


class RosGraph(GraphView):
    """A view of a graph that knows the ends of services, too."""

    @abstractmethod
    def count_callers(self, service: str) -> int:
        """Return the number of clients of a service, connected or not."""

    @abstractmethod
    def request_readers(self, service: str) -> Sequence[EndInfo]:
        """Return the ends at which servers of a service take requests; none if it is not known."""

    @abstractmethod
    def answer_writers(self, service: str) -> Sequence[EndInfo]:
        """Return the ends at which servers of a service answer; none if it is not known."""


class NodeLife:
    """The end of a node, of which everything hears that waits for something to arrive."""

    error: ConnectionLost | None = None
    """The reason for which nothing more will arrive, if so."""

    def __init__(self) -> None:
        self._lost: list[Callable[[ConnectionLost], None]] = []
        self.told: set[str] = set()
        """The problems that users have been told of, by an error or by the log."""

    @property
    def is_up(self) -> bool:
        """True if ROS can still be used."""
        return self.error is None

    def raise_if_lost(self) -> None:
        """Raise `ConnectionLost` if nothing more will arrive."""
        if not self.is_up:
            raise ConnectionLost(str(self.error))

    def on_loss(self, call: Callable[[ConnectionLost], None]) -> Callable[[], None]:
        """Call this if nothing more will arrive. The function that is returned takes it back."""
        self._lost.append(call)
        return lambda: self._lost.remove(call)

    def fail(self, error: ConnectionLost) -> None:
        """End everything that is pending, and everything that is tried later, with an error."""
        if self.error is None:
            self.error = error
            for call in self._lost:
                call(error)


class RosNode(NodeLife, RosGraph):
    """A node in a graph of ROS.

    Methods that make a part raise `TransportError` if ROS does not allow it. All parts are removed
    when the node is closed.
    """

    types: RosTypes
    clock: RosClock
    parameters: ParameterStore
    """The parameters of the node itself."""
    full_name: str
    """The name with the namespace, for example `/robot/arm`."""
    namespace: str
    """The namespace, for example `/robot`; `/` without one."""
    tells_signs: bool
    """True if a `LifeWatch` tells of each sign of life, so that a server without any is silent."""
    matches_by_qos: bool = True
    """False if ends hear each other whatever their quality of service is, as over Zenoh."""
    confirms_callers: bool = True
    """True if an available server is known to have found its client, to which it will answer."""

    @property
    def is_cut(self) -> bool:
        """True if the node has lost its network, which may come back: the graph is unknown then."""
        return False

    async def last_words(self) -> None:
        """Wait for messages to arrive that a server has sent before it left the graph. After it,
        `is_cut` is right: a server may seem to leave because the network was lost.
        """
        await anyio.sleep(LAST_WORDS)

    @abstractmethod
    def resolve(self, name: str) -> str:
        """Return the full name of a topic or a service, as the node expands and remaps it.

        Raises:
            TransportError: ROS does not allow this name.
        """

    @abstractmethod
    def warn(self, text: str) -> None:
        """Log a warning as one line in ROS's own log, which other nodes can read."""

    @abstractmethod
    def complain(self, text: str) -> None:
        """Log an error as one line in ROS's own log."""

    # Parts

    @abstractmethod
    def publisher(self, topic: str, message_type: Any, qos: EndQos) -> TopicPublisher:
        """Make a publisher of a topic, by its full name."""

    @abstractmethod
    def subscription(
        self,
        topic: str,
        message_type: Any,
        qos: EndQos,
        take: MessageSink,
        *,
        is_first: bool = False,
    ) -> TopicSubscription:
        """Make a subscription to a topic.

        If messages arrive together, those of the parts that were made first are taken first; with
        `is_first`, those of this one come before all others.
        """

    @abstractmethod
    def caller(
        self,
        service: str,
        service_type: Any,
        qos: EndQos,
        take: AnswerSink,
        take_unreadable: ErrorSink | None = None,
        take_unanswered: UnansweredSink | None = None,
    ) -> ServiceCaller:
        """Make a client of a service. A middleware that cannot tell what has no answer never calls
        `take_unanswered`.
        """

    @abstractmethod
    def provider(
        self, service: str, service_type: Any, qos: EndQos, take: RequestSink
    ) -> ServiceProvider:
        """Make a server of a service."""

    @abstractmethod
    def life_watch(self, topic: str, message_type: Any, qos: EndQos) -> LifeWatch:
        """Watch for signs of life of the publishers of a topic whose lease is not longer than that
        of the QoS.
        """

    @abstractmethod
    def remove(self, part: NodePart) -> None:
        """Remove a part of this node from the graph; its sinks are called no more."""

    @abstractmethod
    def introspect(self, level: str, *services: ServiceCaller | ServiceProvider) -> None:
        """Publish events of services: `off`, `metadata` or `contents`.

        Raises:
            TransportError: The middleware's adapter cannot do it.
        """

    # The graph

    async def graph_news(self, seconds: float) -> None:
        """Wait until the graph may have changed, and at most so many seconds. By default, nothing
        tells, and it takes all of them.
        """
        await anyio.sleep(seconds)

    async def until(self, look: Callable[[], FoundT]) -> FoundT:
        """Look at the graph until something is found there that is not empty, and return it.

        Raises:
            ConnectionLost: Nothing more will arrive.
        """
        while not (found := look()):
            self.raise_if_lost()
            await self.graph_news(LOOK_PAUSE)
        return found

    def observed(self) -> AbstractAsyncContextManager[GraphView]:
        """Return a view of the graph to look at while the block lasts. By default, it is the node
        itself; a middleware that does not tell how far discovery has come may have another one.
        """
        return nullcontext(self)

    async def links(self) -> Links:
        """Return the connections to others, as far as the middleware tells of them."""
        return Links({}, "")

    async def learn(self, actions: Sequence[tuple[str, str]]) -> None:
        """Learn the types of actions that `types` does not know from their servers, if the
        middleware can ask them. It takes a second at most.

        Each action is given by its feedback topic and its type.
        """

    async def learn_topic(self, topic: str, type_name: str) -> None:
        """Learn the type of a topic's messages from its publishers, if `types` does not know it,
        and if the middleware can ask them. It takes a second at most.
        """


class RosAdapter(ABC):
    """The way to a graph of ROS."""

    types: RosTypes

    @abstractmethod
    def open(self) -> AbstractAsyncContextManager[RosNode]:
        """Open a node for as long as the block lasts.

        Raises:
            TransportError: ROS does not allow such a node, or it cannot be made.
        """
